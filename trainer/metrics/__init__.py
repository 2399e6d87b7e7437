"""Metrics; each name carries its definition."""
