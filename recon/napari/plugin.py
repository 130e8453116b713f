"""The napari plugin: reads and writes layers, and reconstructs the selected one without blocking the viewer.

Annotations of the widget are evaluated in this module, because magicgui creates the form from them.
"""

import inspect
import queue
import textwrap
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from noiseflow import io
from noiseflow.io.mapped import is_large
from noiseflow.progress import Progress
from recon.names import FIELDS, field_names
from recon.uncertainty.result import error_bar_paths

_BUTTON, _PERCENT = "Reconstruct", 100
LayerData = tuple[Any, dict[str, Any], str]


def get_reader(path: str | list[str]) -> Callable[[str | list[str]], list[LayerData]] | None:
    """The reader for a path, or None if noiseflow cannot read it; only single paths are supported."""
    if not isinstance(path, str) or Path(path).suffix.lower() not in io.SUFFIXES:
        return None
    return read_layers


def read_layers(path: str | list[str]) -> list[LayerData]:
    """Read an image, tilt series or volume as a layer, with its voxel size in Å; error bars next to it become hidden layers.
    Raises FileNotFoundError, ValueError as `noiseflow.io.read`.

    Tilt angles in or next to the file are stored in the metadata of the layer as ``tilt_angles``, degrees. The tilt axis of the
    stack counts images, in the unit of the others: napari ignores all units unless those of its layers agree.
    """
    source = path if isinstance(path, str) else path[0]
    image = _read(source)
    metadata: dict[str, Any] = {"source": source}
    axes = axes_of(image.voxel_size, image.data.ndim)
    if image.data.ndim == 3:
        try:
            metadata["tilt_angles"] = io.tilts_of(source, image).angles
        except (FileNotFoundError, ValueError):  # no tilt series, or a list of angles of another one
            pass
        else:
            axes |= {"scale": (1.0, *axes["scale"][1:]), "axis_labels": ("tilt", "y", "x")}
    if image.voxel_size is not None:
        metadata["voxel_size"] = image.voxel_size
    own = (image.data, {"name": Path(source).stem, "metadata": metadata, **axes}, "image")
    beside = [path for path in error_bar_paths(source).values() if path.exists()]
    return [own, *(error_bar_layer(_read(path).data, path.stem, own[1]) for path in beside)]


def axes_of(voxel_size: Sequence[float] | None, dimensions: int = 3) -> dict[str, Any]:
    """Scale, units and names of the axes of a layer: Å where the size of a voxel (z, y, x) is known, otherwise pixels."""
    unit, size = ("pixel", (1.0, 1.0, 1.0)) if voxel_size is None else ("angstrom", voxel_size)
    names = ("z", "y", "x")[-dimensions:]
    return {"scale": tuple(size[-dimensions:]), "units": (unit,) * dimensions, "axis_labels": names}


def _read(path: str | Path) -> io.ImageFile:
    """Read a file; large files are memory-mapped."""
    return io.read(path, mapped=is_large(path))


def error_bar_layer(values: Any, name: str, volume: Mapping[str, Any]) -> LayerData:
    """A hidden layer of standard deviations or biases at the position of its volume, with a diverging colour map."""
    reach = max(float(np.abs(section).max()) for section in values) or 1.0
    look = {"name": name, "visible": False, "colormap": "PiYG", "contrast_limits": (-reach, reach)}
    axes = {name: volume[name] for name in ("scale", "units", "axis_labels")}
    return values, {**look, **axes, "metadata": dict(volume["metadata"])}, "image"


def write_image(path: str, data: Any, attributes: Mapping[str, Any]) -> list[str]:
    """Write one layer as MRC, TIFF, NumPy or OME-Zarr, and return the path. Raises ValueError if the suffix is unknown, or the
    format cannot store the pixels.
    """
    pixels = np.asarray(data)
    size = attributes.get("metadata", {}).get("voxel_size")
    io.write(path, pixels, voxel_size=None if size is None else tuple(size))
    return [path]


def reconstruct_layers(
    images: Any,
    metadata: dict[str, Any],
    *,
    angles: Path | None = None,
    mode: str = "auto",
    method: str = "auto",
    field: str = FIELDS.first,
    thickness: int = 0,
    num_steps: int = 0,
    invert_tilt: bool = False,
    uncertainty: int = 0,
    progress: "Progress | None" = None,
) -> list[LayerData]:
    """Reconstruct a tilt series as a layer (z, y, x), with the verdict in its metadata. Error bars become hidden layers. Raises
    ValueError if there are no tilt angles, or the series cannot be reconstructed with these settings.

    Args:
        images: (tilt, y, x), tilt axis along y.
        metadata: metadata of the layer; ``tilt_angles`` (degrees) and ``voxel_size`` (Å) are used if present.
        mode: ``transmission`` (bright field), ``linear`` (HAADF, EDX), or ``auto``, by the background.
        field: one of `recon.fields.field_names`; the default for methods with a field of their own.
        thickness: voxels along the beam; 0 for the image width.
        num_steps: steps of the fit; 0 for the default of the method.
    """
    from recon.methods._registry import reconstruct
    from recon.series.prepare import prepare
    from recon.series.screening import mode_of_good_tilts
    from recon.series.tilt_series import TiltSeries, VolumeGrid
    from recon.verdict.judge import judge

    known = metadata.get("tilt_angles") if angles is None else io.read_tilts(angles).angles
    if known is None:
        raise ValueError("this layer has no tilt angles; choose an angle file")
    size = metadata.get("voxel_size")
    pixel_size = None if size is None else float(size[-1])
    sign = -1.0 if invert_tilt else 1.0
    given: Any = "transmission" if mode == "auto" else mode
    series = TiltSeries(np.asarray(images), sign * np.asarray(known), pixel_size, given)
    if mode == "auto":
        series = replace(series, mode=mode_of_good_tilts(series) or given)
    prepared = prepare(series)
    series = prepared.tilt_series
    grid = VolumeGrid.of(series, thickness or None)
    options: dict[str, Any] = {"num_steps": num_steps or None, "uncertainty": uncertainty, "progress": progress}
    options["field"] = None if field == FIELDS.first else field
    outcome = reconstruct(series, grid, method=method, **options)
    voxel_size = None if pixel_size is None else (pixel_size,) * 3
    verdict = judge(series, outcome, screening=prepared.screening, guard=prepared.guard)
    result: dict[str, Any] = {"verdict": verdict.lines()} | ({} if voxel_size is None else {"voxel_size": voxel_size})
    look = {"name": f"volume ({outcome.method})", "metadata": result, **axes_of(voxel_size)}
    beside = {} if outcome.uncertainty is None else outcome.uncertainty.parts
    return [
        (outcome.volume.attenuation, look, "image"),
        *(error_bar_layer(each.attenuation, name, look) for name, each in beside.items()),
    ]


def reconstruct_widget() -> Any:
    """Create the form; the volume becomes a new layer, and napari shows the progress."""
    from magicgui import magicgui
    from napari.layers import Image
    from napari.viewer import Viewer

    from recon.methods import method_names

    def start(viewer: Viewer, tilts: Image, num_steps: int = 0, **options: Any) -> None:
        worker = _worker(tilts.data, dict(tilts.metadata), num_steps, options)
        button = form.call_button
        button.enabled, button.text = False, "Reconstructing …"
        worker.yielded.connect(lambda done: setattr(button, "text", f"Reconstructing: {done} %"))
        worker.returned.connect(lambda layers: _show(viewer, tilts, layers))
        worker.finished.connect(lambda: setattr(button, "text", _BUTTON))
        worker.finished.connect(lambda: setattr(button, "enabled", True))
        worker.start()

    settings = inspect.signature(reconstruct_layers).parameters.values()
    shown = [each for each in settings if each.kind is each.KEYWORD_ONLY and each.name != "progress"]
    layers = list(inspect.signature(start).parameters.values())[:2]
    start.__signature__ = inspect.Signature([*layers, *shown])  # type: ignore[attr-defined]
    form: Any = magicgui(
        start,
        call_button=_BUTTON,
        angles={"mode": "r", "nullable": True, "label": "angle file", "tooltip": "required if the layer has no angles"},
        mode={
            "choices": ["auto", "transmission", "linear"],
            "tooltip": "linear: HAADF, EDX; transmission: bright field",
        },
        method={"choices": [name for name in method_names() if name != "joint-supervised"]},
        field={"choices": field_names(), "tooltip": "what a fitted volume is made of"},
        thickness={"min": 0, "max": 10_000, "label": "thickness (0: width)", "tooltip": "voxels along the beam"},
        num_steps={"min": 0, "max": 10_000, "label": "steps (0: default)"},
        uncertainty={"min": 0, "max": 1000, "label": "samples for error bars (0: none)"},
    )
    return form


def _show(viewer: Any, tilts: Any, layers: list[LayerData]) -> None:
    """Replace the tilts by the volume and its error bars, and show its middle section with the verdict."""
    for values, look, _ in layers:
        viewer.add_image(values, **look)
    tilts.visible = False
    values, look, _ = layers[0]
    viewer.dims.set_point(0, look["scale"][0] * (len(values) // 2))
    viewer.text_overlay.text = "\n".join(textwrap.fill(line, 44) for line in look["metadata"]["verdict"])
    viewer.text_overlay.position, viewer.text_overlay.visible = "top_left", True


def _worker(images: Any, metadata: dict[str, Any], num_steps: int, options: dict[str, Any]) -> Any:
    """A worker that fits in a separate thread and yields each percent once, which napari's progress bar counts."""
    from napari.qt.threading import create_worker

    def run() -> Generator[int, None, list[LayerData]]:
        percents, fit = queue.SimpleQueue[int | None](), Future[list[LayerData]]()
        fit.add_done_callback(lambda _: percents.put(None))
        settings = {**options, "num_steps": num_steps}
        settings["progress"] = lambda task, done, total, note: percents.put(_PERCENT * done // total)

        def compute() -> None:
            try:
                fit.set_result(reconstruct_layers(images, metadata, **settings))
            except Exception as error:  # passed to the viewer, which shows it
                fit.set_exception(error)

        threading.Thread(target=compute, daemon=True).start()
        shown = 0
        while (percent := percents.get()) is not None:
            yield from range(shown + 1, percent + 1)
            shown = max(shown, percent)
        return fit.result()

    return create_worker(run, _progress={"total": _PERCENT, "desc": "Reconstruct"})
