from .page import even_odd as even_odd
from .page import read_reference as read_reference
from .page import reconstruction_report as reconstruction_report
from .page import settings as settings
