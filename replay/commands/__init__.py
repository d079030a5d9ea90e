"""The commands of `egoloc`, one frozen dataclass each: fields are the options, run() does the work."""
