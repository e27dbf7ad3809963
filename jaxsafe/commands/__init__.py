"""What is typed in a shell: a module a command."""
