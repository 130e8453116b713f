from . import adapters as adapters
from . import io as io
from . import metrics as metrics
from .baselines import Gaussian as Gaussian
from .baselines import Poisson as Poisson
from .digitisation import Digitisation as Digitisation
from .digitisation import detect_digitisation as detect_digitisation
from .digitised import Digitised as Digitised
from .fit import fit as fit
from .fit_loop import FitResult as FitResult
from .flow import RadialFlow as RadialFlow
from .flow import SignalDependentGaussian as SignalDependentGaussian
from .flow import SplineFlow as SplineFlow
from .mixture import Mixture as Mixture
from .model_files import load as load
from .model_files import save as save
from .physical import PoissonGaussian as PoissonGaussian
from .physics_flow import PhysicsFlow as PhysicsFlow
from .pixel_maps import WithMaps as WithMaps
from .protocols import NoiseModel as NoiseModel
from .protocols import SignalModel as SignalModel
from .scan_noise import ScanNoise as ScanNoise
from .signal_models import KnownSignal as KnownSignal
from .signal_models import StaticScene as StaticScene

__version__: str
