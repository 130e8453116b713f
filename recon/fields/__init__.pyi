from .fields import Field as Field
