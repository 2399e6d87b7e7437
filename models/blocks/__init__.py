"""Modules with parameters that several networks use."""
