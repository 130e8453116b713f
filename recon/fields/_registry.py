"""Look-up of fields by name."""

from __future__ import annotations

from recon.fields.fields import Field
from recon.names import AUTO, FIELDS
from recon.names import field_names as field_names

# what auto compares: plain voxels converge more slowly than grids, and the network of 2022 more slowly than that of sines
_COMPARED = (FIELDS.first, "gaussians", "network")


def find_field(name: str) -> type[Field]:
    """The class of fields with a given name.

    Raises:
        ValueError: the name is unknown, or ``auto``.
        TypeError: the entry point with that name is not a field.
    """
    found = FIELDS.find(name)
    if not (isinstance(found, type) and issubclass(found, Field)):
        raise TypeError(f"field {name} is {found!r}; it must be a class derived from recon.Field")
    return found


def field_kinds(name: str | None) -> dict[str, type[Field]]:
    """The fields that a setting names: one, or those that ``auto`` compares; None names the default. Raises as `find_field`."""
    names = _COMPARED if name == AUTO else (name or FIELDS.first,)
    return {each: find_field(each) for each in names}


def name_of(field: Field) -> str:
    """The name of a field.

    Raises:
        ValueError: its class is not registered.
    """
    for name in FIELDS.names():
        if name != AUTO and find_field(name) is type(field):
            return name
    raise ValueError(f"{type(field).__name__} is not a named field; register it as an entry point of {FIELDS.group}")
