"""The kinds of fields: every module of this package is one, with a class `FIELD`."""
