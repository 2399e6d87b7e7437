"""One module per published on-disk layout; each has `frames(root)`."""
