"""The command `noiseflow reconstruct`."""

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import noiseflow
from noiseflow.commands.console import Output, choose_device, show_warning, with_options
from noiseflow.progress import progress_shown
from noiseflow.runs.outputs import Outputs
from recon.commands.options import ReconstructOptions, method_of
from recon.names import ALIGNMENTS


@with_options
def reconstruct(options: ReconstructOptions) -> None:
    """Reconstruct a clean volume, and the noise model with it, from one noisy tilt series.

    Ctrl-C saves the state and prints how to resume; a second Ctrl-C stops at once. The tilts may be in any order.
    """
    from recon.commands.results import Targets, channels_of, joined_results, prepared_channels
    from recon.commands.volume_run import VolumeRun

    output = Output(options.json)
    channels, channel = channels_of(options.tilts, options.channel)
    options = replace(options, channel=channel, method=method_of(options.method, options.preset))
    options.check(several="" not in channels)
    device = choose_device(options.device)
    inputs = (*channels.values(), options.reference_channel, options.angles, *options.shared_inputs)
    with Outputs(*inputs, overwrite=options.overwrite) as outputs, warnings_as_lines() as warned:
        outputs.file(options.save_alignment, suffixes=ALIGNMENTS)
        targets = {name: Targets.of(options, name, outputs) for name in channels}
        outputs.options(None if options.dry_run else options.out)
        fixed = None if options.noise_model is None else noiseflow.load(options.noise_model)
        with progress_shown(json_mode=options.json) as progress:
            prepared = prepared_channels(channels, options, output, device, progress)
        ideal = fixed.without_converter() if isinstance(fixed, noiseflow.WithMaps) else fixed
        run = VolumeRun(options, output, device, ideal, warned)
        results = {}
        for name, each in prepared.items():
            angles = options.angles or noiseflow.io.angle_file_of(channels[name])
            read = [channels[name], *([angles] if angles else []), *options.shared_inputs]
            results[name] = run(each, targets[name], read)
        written = results[""] if "" in results else joined_results(results, options.report, output)
    output.result(written)
    worst = next((result for result in results.values() if result.get("verdict", {}).get("grade") == "bad"), None)
    if options.strict and worst is not None:
        raise ValueError(f"--strict: bad verdict ({worst['volume']} is written). {worst['verdict']['reasons'][0]}")


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[list[str]]:
    """Show each warning once, as one line; yield the list that collects them."""
    told: list[str] = []

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = " ".join(str(message).split())
        if text not in told:
            told.append(text)
            show_warning(text, category)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield told
