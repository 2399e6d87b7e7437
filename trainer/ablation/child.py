"""`trainer fit` in a process that ends with the one that started it.

A training that is left behind would still write its run while the next call goes on with that.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PARENT = "PENUMBRA_ABLATION_PARENT"
"""Process that the training belongs to."""

_PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Have the kernel kill this process when its parent ends, on Linux; a killed training can go on."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    expected = os.environ.pop(PARENT, "")  # processes that this one starts are children of another
    if expected and int(expected) != os.getppid():
        sys.exit(137)  # it ended before


if __name__ == "__main__":
    end_with_parent()
    from trainer.cli import main

    sys.exit(main())
