"""Networks and distributions, and nothing else."""
