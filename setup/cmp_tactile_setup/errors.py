"""The one exception of the set-up."""


class SetupError(Exception):
    """Something that the user has to put right; its text is one line that says what and how."""
