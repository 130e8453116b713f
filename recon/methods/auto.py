"""The method that is used where none is named."""

from dataclasses import replace

from recon.methods import joint

METHOD = replace(joint.METHOD, name="auto", description="The joint fit.")
