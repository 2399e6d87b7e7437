"""Everything that runs: the command line, training, export, reports."""
