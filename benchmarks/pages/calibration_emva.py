"""EMVA 1288 figures beside those of the packages emva1288 and getframes: `python -m benchmarks.pages.calibration_emva`.

All three measure the same frames: flats at several levels and dark frames, of a simulator of known truth and of cameras that
getframes simulates. The figures go into results/calibration.json and calibration.md. Needs `pip install emva1288 getframes`.
"""

from __future__ import annotations

import json
import logging
import time
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.pages import FOLDER

RESULTS = FOLDER / "results" / "calibration.json"
SIZE, FRAMES, DARKS, STEPS = 200, 8, 16, 16
LARGEST = 1.2
"""Brightest level in saturation capacities: the standard asks for levels beyond saturation."""

FIGURES = {
    "gain": "gain, counts/e⁻",
    "dark_noise": "dark noise, e⁻",
    "snr_maximum": "largest SNR",
    "saturation": "saturation capacity, e⁻",
    "dynamic_range": "dynamic range",
    "linearity_error": "mean linearity error, %",
    "dsnu": "DSNU, e⁻",
    "prnu": "PRNU, %",
    "seconds": "processor time, s",
}
Stack = NDArray[np.float64]
Found = dict[str, float | None]


def own_camera() -> tuple[list[Stack], Stack, list[float], Found]:
    """Flats, darks, their light and the truth: read noise 3 e⁻, DSNU 2 e⁻, PRNU 1 %, full well 9000 e⁻, gain 2."""
    generator = np.random.default_rng(0)
    shape, full = (SIZE, SIZE), 9000.0
    response, offset = 1 + 0.01 * generator.standard_normal(shape), 100 + 4 * generator.standard_normal(shape)

    def frames(electrons: float, number: int) -> Stack:
        charge = np.minimum(generator.poisson(electrons * response, (number, *shape)), full)
        return np.round(offset + 2 * (charge + 3 * generator.standard_normal(charge.shape)))

    light = [float(value) for value in np.linspace(LARGEST * full / STEPS, LARGEST * full, STEPS)]
    truth: Found = _truth(2.0, 3.0, full) | {"linearity_error": 0.0, "dsnu": 2.0, "prnu": 1.0}
    return [frames(one, FRAMES) for one in light], frames(0.0, DARKS), light, truth


def getframes_camera(name: str) -> tuple[list[Stack], Stack, list[float], Found]:
    """The same of a preset of getframes, 0.01 s long."""
    import getframes

    camera = getframes.Camera.from_preset(name).with_config(resolution=(SIZE, SIZE))
    config, seed, exposure = camera.config, zlib.crc32(name.encode()), 0.01
    end = (2**config.bit_depth - 1 - config.bias_offset_adu) * config.gain_e_per_adu
    full = min(config.full_well_e, end)

    def frames(electrons: float, number: int) -> Stack:
        nonlocal seed
        rate = np.full((SIZE, SIZE), electrons / config.quantum_efficiency / exposure)
        seed += number
        return np.stack(
            [np.asarray(camera.expose(rate, exposure, seed=seed - one).data, float) for one in range(number)]
        )

    light = [float(value) for value in np.linspace(LARGEST * full / STEPS, LARGEST * full, STEPS)]
    truth: Found = _truth(1 / config.gain_e_per_adu, config.read_noise_e, full)
    truth |= {"linearity_error": None if config.nonlinearity else 0.0, "dsnu": None, "prnu": 100 * config.prnu}
    return [frames(one, FRAMES) for one in light], frames(0.0, DARKS), light, truth


def _truth(gain: float, read_noise: float, full: float) -> Found:
    least = float(np.sqrt(read_noise**2 + 0.25) + 0.5)
    known = {"gain": gain, "dark_noise": read_noise, "saturation": full}
    return known | {"snr_maximum": float(np.sqrt(full)), "dynamic_range": full / least}


def by_noiseflow(flats: list[Stack], dark: Stack, light: list[float]) -> Found:
    from calibration.camera import calibrate_camera
    from calibration.exposures.frames import Burst

    bursts = [Burst(frames, calibration=True) for frames in flats]
    found = calibrate_camera(bursts, [Burst(dark, calibration=True)], flat_times=light).figures
    noise = found.dark_noise
    whole: Found = {"gain": found.gain.median, "dark_noise": None if noise is None else noise.median}
    whole |= {name: getattr(found, name) for name in ("snr_maximum", "saturation", "dynamic_range", "dsnu")}
    shares = {name: getattr(found, name) for name in ("linearity_error", "prnu")}
    return whole | {name: None if value is None else 100 * value for name, value in shares.items()}


def by_emva1288(flats: list[Stack], dark: Stack, light: list[float]) -> Found:
    """Two frames of each level tell the temporal noise, all frames of the middle level the spatial one."""
    from emva1288.process import routines
    from emva1288.process.data import Data1288
    from emva1288.process.results import Results1288

    if not hasattr(np, "asfarray"):  # version 1.0.2 was written for NumPy 1
        setattr(np, "asfarray", lambda values: np.asarray(values, float))  # noqa: B010

    def temporal(frames: Stack) -> dict[str, Any]:
        one = routines.get_int_imgs(list(frames[:2].astype(np.int64)))
        return {"sum": one["sum"].sum(), "pvar": one["pvar"].sum(), "dmean": one["dmean"]}

    def spatial(frames: Stack) -> dict[str, Any]:
        return dict(routines.get_int_imgs(list(frames.astype(np.int64))))

    points = {0.0: temporal(dark)} | {one: temporal(frames) for one, frames in zip(light, flats, strict=True)}
    middle = int(np.argmin(np.abs(np.array(light) - 0.5 * light[-1])))
    both = {0.0: spatial(dark), light[middle]: spatial(flats[middle])}
    data = {"width": SIZE, "height": SIZE, "temporal": {1.0: points}, "spatial": {1.0: both}}
    found = Results1288(Data1288(data, loglevel=logging.ERROR).data, loglevel=logging.ERROR)
    used = slice(found.index_linearity_min, found.index_linearity_max + 1)
    return {
        "gain": float(found.K),
        "dark_noise": float(found.sigma_d),
        "snr_maximum": float(found.SNR_max),
        "saturation": float(found.u_e_sat),
        "dynamic_range": float(found.DR),
        "linearity_error": float(np.mean(np.abs(found.linearity()["relative_deviation"][used]))),
        "dsnu": float(found.DSNU1288),
        "prnu": float(found.PRNU1288),
    }


def by_getframes(flats: list[Stack], dark: Stack, light: list[float]) -> Found:
    """What its characterize_flat reports; its read noise is that of the faintest level."""
    from getframes.analysis.characterize import characterize_flat, stack_statistics

    stacks = {one: stack_statistics(frames) for one, frames in zip(light, flats, strict=True)}
    found = characterize_flat(stacks, bias_adu=float(dark.mean()))
    return {
        "gain": 1 / found.gain_e_per_adu,
        "dark_noise": found.read_noise_e,
        "saturation": found.full_well_e,
        "prnu": 100 * found.prnu,
    }


def timed(measure: Callable[..., Found], flats: list[Stack], dark: Stack, light: list[float]) -> Found:
    """The figures of a package, and its processor time from arrays to figures, the second time, when all is imported."""
    measure(flats, dark, light)
    started = time.process_time()
    return measure(flats, dark, light) | {"seconds": time.process_time() - started}


TOOLS = {"noiseflow": by_noiseflow, "emva1288": by_emva1288, "getframes": by_getframes}


def main() -> None:
    from benchmarks.pages import calibration_page
    from benchmarks.provenance import origin

    cameras = {"simulator of known truth": own_camera}
    cameras |= {
        f"getframes {name}": lambda name=name: getframes_camera(name) for name in ("generic_cmos", "generic_scmos")
    }
    found: dict[str, Any] = {
        "names": FIGURES,
        "cameras": {},
        "levels": STEPS,
        "frames": FRAMES,
        "darks": DARKS,
    } | origin()
    for name, make in cameras.items():
        flats, dark, light, truth = make()
        end = max(
            frames.max() for frames in flats
        )  # noiseflow refuses frames that hold nothing but the converter's end
        kept = [index for index, frames in enumerate(flats) if np.mean(frames == end) < 0.5]
        flats, light = [flats[index] for index in kept], [light[index] for index in kept]
        found["cameras"][name] = {"truth": truth} | {
            tool: timed(measure, flats, dark, light) for tool, measure in TOOLS.items()
        }
    content = json.loads(RESULTS.read_text(encoding="utf-8")) | {"emva": found}
    RESULTS.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    calibration_page.write(content)
    print(calibration_page.page(content).split("## EMVA 1288")[1])


if __name__ == "__main__":
    main()
