from .likelihood import misfit as misfit
from .measure import EXCESS_NOISE as EXCESS_NOISE
from .measure import LEAST_GAIN as LEAST_GAIN
from .measure import Detector as Detector
from .measure import measure_detector as measure_detector
from .measure import readings_of as readings_of
