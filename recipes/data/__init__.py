"""Demonstrations: recording them, and reading those of others."""
