"""Noise as a data-augmentation transform: `AddNoise`, in the style of torchvision's transforms v2."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten, tree_unflatten
from torch.utils.data import get_worker_info

from noiseflow.arrays import is_array
from noiseflow.models.wrapper import as_noise_model


class AddNoise(nn.Module):
    """Add the noise of a model to clean images, as a step of a data pipeline.

    The input is an image, or nested tuples, lists and dictionaries with images; the output has the same structure. If the input
    contains ``torchvision.tv_tensors.Image`` or ``Video``, noise is added to these, otherwise to the first tensor or array.
    Masks, boxes, labels and everything else are returned unchanged.

    Random numbers come from torch's global generator, which a `DataLoader` seeds for each worker and epoch. With `seed` they are
    reproducible: there is one stream in the main process and one for every worker and epoch, derived from `seed` and the seed of
    the worker (set by ``torch.manual_seed`` or the loader's ``generator``).

    Args:
        model: the noise model; images are in its detector units. It must be picklable if workers are spawned.
        seed: seed of the transform's own random streams; None for torch's global generator.
        keep_clean: return pairs (noisy, clean) instead of noisy images, for supervised training.
    """

    def __init__(self, model: nn.Module, *, seed: int | None = None, keep_clean: bool = False) -> None:
        super().__init__()
        self.model, self.seed, self.keep_clean = as_noise_model(model), seed, keep_clean
        self._generator: torch.Generator | None = None
        self._stream: tuple[int, ...] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """State without the random stream, because every process has its own."""
        return self.__dict__ | {"_generator": None, "_stream": None}

    def forward(self, *inputs: Any) -> Any:
        """Return the input with noisy images, in the same structure.

        Args:
            *inputs: images, any shape, detector units; integers are converted to floating point.
        """
        leaves, structure = tree_flatten(inputs if len(inputs) > 1 else inputs[0])
        marked = [leaf for leaf in leaves if _is_marked_image(leaf)]
        plain = [leaf for leaf in leaves if type(leaf) is Tensor or (is_array(leaf) and np.ndim(leaf) > 1)]
        chosen = marked or plain[:1]
        if not chosen:
            raise ValueError("AddNoise found no image in its input; give a tensor, an array, or a structure with one")
        noisy = (self._noisy(leaf) if any(leaf is each for each in chosen) else leaf for leaf in leaves)
        return tree_unflatten(list(noisy), structure)

    @torch.no_grad()
    def _noisy(self, image: Any) -> Any:
        if not isinstance(image, Tensor):
            noisy = self.model(image).sample(generator=self._own_generator(self.model.device))
            return (noisy, image) if self.keep_clean else noisy
        noisy = self.model(image.as_subclass(Tensor)).sample(generator=self._own_generator(image.device))
        if type(image) is not Tensor:
            from torchvision import tv_tensors

            noisy = tv_tensors.wrap(noisy, like=image)
        return (noisy, image) if self.keep_clean else noisy

    def _own_generator(self, device: torch.device) -> torch.Generator | None:
        if self.seed is None:
            return None
        worker = get_worker_info()
        stream = (self.seed,) if worker is None else (self.seed, worker.seed)
        if self._generator is None or stream != self._stream or self._generator.device != device:
            own = np.random.SeedSequence(stream).generate_state(1, np.uint64)[0] >> 1
            self._generator, self._stream = torch.Generator(device).manual_seed(int(own)), stream
        return self._generator

    def extra_repr(self) -> str:
        return f"seed={self.seed}, keep_clean={self.keep_clean}"


def _is_marked_image(leaf: Any) -> bool:
    """Whether this is a torchvision image or video; does not require torchvision."""
    return isinstance(leaf, Tensor) and any(
        kind.__module__.startswith("torchvision.tv_tensors") and kind.__name__ in ("Image", "Video")
        for kind in type(leaf).__mro__
    )
