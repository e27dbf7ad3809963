"""Engine `jax`: MJX in plain JAX, with contacts and a constraint solver of our own."""
