from .fields import field_names as field_names
from .fields import find_field as find_field
from .fields import load_field as load_field
from .fields import save_field as save_field
