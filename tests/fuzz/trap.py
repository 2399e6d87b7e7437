"""Must not be imported because a checkpoint names it: importing runs code."""

raise SystemExit("a checkpoint made the program import this")
