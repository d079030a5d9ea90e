"""The one exception for a user's mistake."""


class EgolocError(ValueError):
    """Bad input: a file, a field or a config key. One line, printed without a traceback, exit code 2."""
