"""The commands: a module each. scripts/ calls them."""
