"""The line of a user's code that a component or an equation comes from, as errors name it."""

import os
import sys

PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep


def line_of_caller() -> str:
    """`models.py:57`, the innermost line outside of this package that leads here; `line 3` in a notebook or at a
    prompt; "" if there is none."""
    # By frames, not by `inspect.stack`, which reads source files: a large model asks a hundred thousand times.
    frame = sys._getframe(1)
    while frame is not None:
        path = frame.f_code.co_filename
        # Decorators that check types run code of their own between a class and its caller.
        if not path.startswith(PACKAGE) and not path.startswith("<@"):
            in_a_file = not path.startswith("<") and "ipykernel" not in path
            return f"{os.path.basename(path)}:{frame.f_lineno}" if in_a_file else f"line {frame.f_lineno}"
        frame = frame.f_back
    return ""
