"""One module per verb of the `trainer` command."""
