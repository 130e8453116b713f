"""Reading and writing of images, tilt angles and alignments. Outputs are written to a temporary file and then renamed.

How a composition works: `images` chooses the reader by the suffix; every reader returns an `ImageFile` in the units of the file.
Files of angles and alignments become a `TiltTable` in the same way (`angles`), which is then joined with the images it lists.
"""

from typing import TYPE_CHECKING, Any

from noiseflow.runs.outputs import atomic_path as atomic_path
from noiseflow.runs.outputs import check_output as check_output
from noiseflow.runs.outputs import output_folder as output_folder
from noiseflow.runs.ownership import locked as locked
from noiseflow.runs.ownership import partial_folder as partial_folder

from .angles import LARGEST_ANGLE as LARGEST_ANGLE
from .angles import angle_file_of as angle_file_of
from .angles import read_tilts as read_tilts
from .angles import tilts_of as tilts_of
from .checks import SeveralImages as SeveralImages
from .checks import require_contrast as require_contrast
from .checks import require_finite as require_finite
from .folder import files_of as files_of
from .image_file import SUFFIXES as SUFFIXES
from .image_file import ImageFile as ImageFile
from .image_file import TiltTable as TiltTable
from .images import read as read
from .images import read_image as read_image
from .images import write as write
from .imod import parse_views as parse_views
from .imod import read_transforms as read_transforms
from .metadata import tilt_axis_of as tilt_axis_of

if TYPE_CHECKING:
    from noiseflow.arrays import as_array as as_array


def __getattr__(name: str) -> Any:
    if name == "as_array":  # imports torch, which commands check their outputs without
        from noiseflow.arrays import as_array

        return as_array
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
