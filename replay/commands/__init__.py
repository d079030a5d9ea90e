"""The commands of `egoloc`, one frozen dataclass each: fields are the options, run() does the work.

A field's docstring is its --help, on one line (tyro breaks the help where the docstring's lines end). What stands for a
default of None is said by ``help_behavior_hint``.
"""
