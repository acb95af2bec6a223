"""What ends a run early, shown as a single line without a traceback."""


class UserError(Exception):
    """Something outside the program is wrong: a path, a file, an option.

    The message is one line: the rule, what came, and a way out.
    """


class RunFailure(Exception):
    """Something broke while a run was learning.

    The message is one line: the cause, and how to go on from what was kept.
    """
