"""Pictures, films and a live view of environments."""
