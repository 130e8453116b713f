"""The commands of this package, one file each. Nothing heavy is imported before a command runs."""
