"""Alignment, metrics and the report."""
