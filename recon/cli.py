"""The door to this package's commands. Nothing heavy is imported before a command runs."""

from recon.commands.compare import compare as compare
from recon.commands.reconstruct import reconstruct as reconstruct
from recon.commands.simulate import simulate as simulate
