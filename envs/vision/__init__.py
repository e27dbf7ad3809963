"""Pictures for policies: what a camera in a MuJoCo model sees, cast in JAX on any device."""
