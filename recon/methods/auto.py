"""The default method."""

from dataclasses import replace

from recon.methods import joint

METHOD = replace(joint.METHOD, name="auto", description="The joint fit.")
