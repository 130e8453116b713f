"""One noise model for several gains of a camera, beside separate models, and at gains between those of the fit.

    python -m benchmarks.pages.conditions [--again] [--page]

A simulated camera (offset 100 counts, read noise 1.5 electrons) with six gains from 1 to 32 counts per electron, 4000 pixels of
0 to 60 electrons at each. Losses are differences of log-likelihood to the true law on 4000 new pixels.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from torch import nn

import noiseflow
from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results

GAINS, BETWEEN = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), (1.4, 6.0, 23.0)
COUNT = 4000
MODELS = {"SignalDependentGaussian": noiseflow.SignalDependentGaussian}


def truth(gain: float) -> noiseflow.PoissonGaussian:
    """The camera at one gain."""
    return noiseflow.PoissonGaussian(gain, 100.0, 1.5)


def exposures(gain: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Signals and observations, (COUNT,) counts."""
    random = torch.Generator().manual_seed(seed)
    signal = 100 + gain * 60 * torch.rand(COUNT, generator=random)
    return signal, truth(gain)(signal).sample(generator=random)


@torch.no_grad()
def loss(model: nn.Module, gain: float) -> float:
    """Nats per pixel behind the truth, on new pixels."""
    signal, observation = exposures(gain, 99)
    return float((truth(gain)(signal).log_prob(observation) - model(signal).log_prob(observation)).double().mean())


def pooled(make: type[noiseflow.NoiseModelBase]) -> noiseflow.Conditioned:
    """One model fitted to all six gains."""
    parts = [exposures(gain, seed) for seed, gain in enumerate(GAINS)]
    signal, observation = (torch.stack(each) for each in zip(*parts, strict=True))
    found = noiseflow.fit(make(), signal, observation, condition={"gain": torch.tensor(GAINS)[:, None]}).noise_model
    assert isinstance(found, noiseflow.Conditioned)
    return found


def measure(name: str) -> dict[str, Any]:
    """Losses of one kind of model: one model and separate ones at the six gains, and the one model between them."""
    one = pooled(MODELS[name])
    alone = [
        noiseflow.fit(MODELS[name](), *exposures(gain, seed)).noise_model.eval() for seed, gain in enumerate(GAINS)
    ]
    return {
        "one": [loss(one.at({"gain": gain}), gain) for gain in GAINS],
        "separate": [loss(model, gain) for model, gain in zip(alone, GAINS, strict=True)],
        "between": [loss(one.at({"gain": gain}), gain) for gain in BETWEEN],
    }


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    head = "| model | fit | " + " | ".join(f"gain {gain:g}" for gain in (*GAINS, *BETWEEN)) + " |"
    rows = [head, "|---|---|" + "---:|" * (len(GAINS) + len(BETWEEN))]
    for name, cell in content["cells"].items():
        for kind, values in (("one model", cell["one"] + cell["between"]), ("separate models", cell["separate"])):
            shown = [f"{value:.4f}" for value in values] + [""] * (len(GAINS) + len(BETWEEN) - len(values))
            rows.append(f"| {name} | {kind} | " + " | ".join(shown) + " |")
    worst = max(
        one - alone
        for cell in content["cells"].values()
        for one, alone in zip(cell["one"], cell["separate"], strict=True)
    )
    between = max(value for cell in content["cells"].values() for value in cell["between"])
    return PAGE.format(
        table="\n".join(rows),
        worst=worst,
        between=between,
        fitted=", ".join(f"{gain:g}" for gain in GAINS),
        others=", ".join(f"{gain:g}" for gain in BETWEEN),
        measured=measured_on([content]),
    )


PAGE = """\
# One noise model for several gains

`noiseflow.fit(..., condition={{"gain": ...}})` gives one model for all gains of a camera. At the fitted gains ({fitted} counts
per electron) it loses at most {worst:.4f} nats per pixel more than separate models (goal 0.005), and between them ({others}) at
most {between:.4f} to the truth (goal 0.02).

```sh
python -m benchmarks.pages.conditions
```

Loss to the true law, nats per pixel, on 4000 new pixels at each gain. The camera has an offset of 100 counts and 1.5 electrons of
read noise; each gain has 4000 pixels of 0 to 60 electrons.

{table}

{measured}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--page", action="store_true", help="write the page only")
    options = parser.parse_args()
    results = Results(FOLDER / "results" / "conditions.json", "conditions")
    for name in [] if options.page else MODELS:
        if options.again:
            results.cells.pop(name, None)
        results.cell(name, lambda n=name: measure(n))  # type: ignore[misc]
    text = page(results.content)
    (FOLDER / "conditions.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
