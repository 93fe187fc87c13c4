"""Shi-Tomasi corners followed by pyramidal Lucas–Kanade."""
