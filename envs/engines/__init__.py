"""Physics engines: MuJoCo models in, batched steps out."""
