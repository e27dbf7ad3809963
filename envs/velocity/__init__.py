"""Velocity tasks of Safety-Gymnasium: run, but not faster than a threshold."""
