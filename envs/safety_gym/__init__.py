"""Safety Gym's tasks."""
