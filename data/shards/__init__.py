"""Shards of training patches: writing and reading."""
