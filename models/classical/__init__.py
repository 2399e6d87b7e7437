"""Denoisers without parameters."""
