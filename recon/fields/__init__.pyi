from .files import field_names as field_names
from .files import find_field as find_field
from .files import load_field as load_field
from .files import save_field as save_field
