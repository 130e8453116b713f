from . import interop as interop
from . import io as io
from . import metrics as metrics
from .fitting.fit import fit as fit
from .fitting.loop import FitResult as FitResult
from .fitting.signal_models import KnownSignal as KnownSignal
from .fitting.signal_models import StaticScene as StaticScene
from .io.model_files import load as load
from .io.model_files import save as save
from .models.baselines import Gaussian as Gaussian
from .models.baselines import Poisson as Poisson
from .models.digitisation import Digitisation as Digitisation
from .models.digitisation import detect_digitisation as detect_digitisation
from .models.digitised import Digitised as Digitised
from .models.excess_noise import ExcessNoise as ExcessNoise
from .models.flow import RadialFlow as RadialFlow
from .models.flow import SignalDependentGaussian as SignalDependentGaussian
from .models.flow import SplineFlow as SplineFlow
from .models.mixture import Mixture as Mixture
from .models.physical import PoissonGaussian as PoissonGaussian
from .models.physics_flow import PhysicsFlow as PhysicsFlow
from .models.pixel_maps import WithMaps as WithMaps
from .models.scan_noise import ScanNoise as ScanNoise
from .protocols import NoiseModel as NoiseModel
from .protocols import SignalModel as SignalModel

__version__: str
