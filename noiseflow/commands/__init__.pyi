from .sampling import evaluate as evaluate
from .sampling import sample as sample
