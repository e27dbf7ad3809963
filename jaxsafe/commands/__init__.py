"""The commands: a module each, called by `jaxsafe` and by scripts/."""
