"""The one kind of error that is the user's to mend and is shown as a single line, without a traceback."""


class UserError(Exception):
    """Something outside the program is wrong: a path, a file, an option.

    The message is one line: the rule, what came, and a way out.
    """
