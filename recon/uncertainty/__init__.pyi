from .posterior import Posterior as Posterior
from .posterior import error_bars as error_bars
from .result import Uncertainty as Uncertainty
