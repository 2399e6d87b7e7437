"""Functions without parameters; each states its formula and source."""
