"""Outputs of runs: nothing that is complete is ever lost, and nothing foreign is overwritten.

How a composition works: a command checks its outputs before it computes (`outputs`), holds their lock and writes
into a temporary folder beside the target (`ownership`), and renames what is complete. A run that can be interrupted keeps
a `RunFolder`: the settings that determine it, the choices that it made, and the states of its parts by name.
"""
