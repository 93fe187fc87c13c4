"""The three encoders, by the name that ``encoder=`` has; importing this package imports torch."""
