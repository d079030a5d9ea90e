"""Replay: logs through the filter, scored against a reference; the command line, run folders and views of them."""
