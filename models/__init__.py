"""Denoisers: torch only, no files, no Lightning, no MLflow."""
