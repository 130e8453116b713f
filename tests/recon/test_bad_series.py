"""Bad tilt series through the command: one clear line and no volume, or a stated recovery."""

import numpy as np
import pytest

ANGLES = np.arange(-60, 61, 10.0)


@pytest.fixture(scope="module")
def images():
    """A bright-field series of a rod along the axis and a ball, with a little noise."""
    generator = np.random.default_rng(0)
    u = np.arange(16) - 7.5
    centre = 4 * np.cos(np.deg2rad(ANGLES))[:, None, None]
    chord = np.sqrt(np.clip(9 - (u - centre) ** 2, 0, None)) * np.ones((1, 12, 1))
    return (np.exp(-0.2 * chord) + 0.02 * generator.normal(size=chord.shape)).astype(np.float32)


def command(folder, images, angles, *options):
    np.save(folder / "tilts.npy", images)
    np.savetxt(folder / "tilts.tlt", angles)
    return ["reconstruct", folder / "tilts.npy", "-o", folder / "volume.npy", "--method", "wbp", *options]


def at(images, value, count=7):
    damaged = images.copy()
    damaged[2, 3:5, 1 : 1 + count] = value
    return damaged


@pytest.mark.parametrize(
    ("damage", "options", "words"),
    [
        (lambda i, a: (i, a[:-1]), [], "13 images, but there are 12"),
        (lambda i, a: (i, np.append(a, 70)), [], "13 images, but there are 14"),
        (lambda i, a: (i, np.zeros_like(a)), [], "different angles"),
        (lambda i, a: (i[:1], a[:1]), [], "tilts.npy: 1 of 1 views are in use; a tilt series needs at least two tilts"),
        (lambda i, a: (i, a), ["--exclude-views", "2-13"], "tilts.npy: 1 of 13 views are in use"),
        (lambda i, a: (i[0], a), [], "one image"),
        (lambda i, a: (i.astype(complex), a), [], "complex"),
        (lambda i, a: (np.full_like(i, 0.5), a), [], "flat"),
        (lambda i, a: (at(i, np.nan), a), [], "--mask-nan"),
        (lambda i, a: (at(i, np.inf), a), [], "--mask-nan"),
        (lambda i, a: (np.full_like(i, np.nan), a), ["--mask-nan"], "no usable pixel"),
        (lambda i, a: (-1 - i, a), ["--mode", "transmission"], "linear"),
        (lambda i, a: (i, a), ["--thickness", -3], "thickness"),
        (lambda i, a: (i, a), ["--thickness", 33], "more than twice"),
        (lambda i, a: (i, a), ["--angles", "none.tlt"], "none.tlt"),
    ],
)
def test_impossible_series_gives_one_line_and_no_volume(images, tmp_path, refused, damage, options, words):
    assert words in refused(*command(tmp_path, *damage(images, ANGLES), *options))
    assert not (tmp_path / "volume.npy").exists()
    assert not (tmp_path / "volume.npy.checkpoint").exists()


@pytest.mark.parametrize(
    ("damage", "options", "words"),
    [
        (lambda i, a: (i, np.deg2rad(a)), [], "radians"),
        (lambda i, a: (np.concatenate([i, i[:1]]), np.append(a, a[0])), [], "more than once"),
        (lambda i, a: (1 - i, a), ["--mode", "transmission"], "--invert-contrast"),
        (lambda i, a: (at(i, 1e5, 1), a), [], "deviate a hundred times"),
        (lambda i, a: (i, a), ["--mode", "linear"], "--mode transmission"),
        (
            lambda i, a: (np.concatenate([i, np.full_like(i[:1], np.nan)]), np.append(a, 70)),
            ["--mask-nan"],
            "excluded: 70",
        ),
    ],
)
def test_doubtful_series_is_reconstructed_with_a_word(images, tmp_path, run, damage, options, words):
    result = run(*command(tmp_path, *damage(images, ANGLES), *options))
    assert any(words in warning for warning in result["warnings"]), result["warnings"]
    assert np.isfinite(np.load(tmp_path / "volume.npy")).all()


@pytest.mark.parametrize(
    "order", [[*range(13)], [6, 7, 5, 8, 4, 9, 3, 10, 2, 11, 1, 12, 0]], ids=["rising", "dose-symmetric"]
)
def test_good_series_causes_no_warning(images, tmp_path, run, order):
    assert run(*command(tmp_path, images[order], ANGLES[order]))["warnings"] == []


def test_masked_pixels_are_as_good_as_their_neighbours(images, tmp_path, run):
    options = ["--window", "hann"]
    run(*command(tmp_path, images, ANGLES, *options))
    whole = np.load(tmp_path / "volume.npy")
    run(*command(tmp_path, at(images, np.nan, 1), ANGLES, *options, "--mask-nan"))
    assert np.abs(np.load(tmp_path / "volume.npy") - whole).max() < 0.1 * whole.max()


def test_swapped_contrast_is_swapped_back(images, tmp_path, run):
    run(*command(tmp_path, images, ANGLES))
    right = np.load(tmp_path / "volume.npy")
    top = images.max() + images.min()
    assert run(*command(tmp_path, top - images, ANGLES, "--invert-contrast"))["warnings"] == []
    np.testing.assert_allclose(np.load(tmp_path / "volume.npy"), right, atol=1e-4)
