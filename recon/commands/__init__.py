"""The commands of this package, one file each. Large packages are imported only when a command runs.

How a composition works: `reconstruct` reads its channels (`inputs`), checks where each writes (`results.Targets`), and calls a
`VolumeRun` for each, which plans, fits under a journal and writes.
"""
