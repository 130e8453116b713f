"""The commands of this package, one file each. Large packages are imported only when a command runs."""
