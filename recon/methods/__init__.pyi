from ._registry import Method as Method
from ._registry import Settings as Settings
from ._registry import find_method as find_method
from ._registry import method_names as method_names
from ._registry import reconstruct as reconstruct
from ._registry import settings_of as settings_of
