"""Try the libraries that come with compiled code, each in a process of its own: a bad one takes only that along."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from pano_mvs.cli.doctor.finding import Finding, State

TIMEOUT_S = 180.0
_PIP = "pip install --force-reinstall --no-deps"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a probe.

    Attributes:
        said: the JSON object that it printed last, or None.
        why: why there is none.
    """

    said: Mapping[str, Any] | None
    why: str = ""


Try = Callable[[str], Outcome]

_NUMBA = """
import json, time
import numba, numpy
began = time.perf_counter()
@numba.njit(error_model="numpy", nogil=True)
def total(values):
    found = 0.0
    for value in values:
        found += value
    return found
assert total(numpy.arange(10.0)) == 45
disabled = bool(numba.config.DISABLE_JIT)
print(json.dumps({"version": numba.__version__, "seconds": time.perf_counter() - began, "disabled": disabled}))
"""

_PYCOLMAP = """
import json
import numpy, pycolmap
camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=200, height=100, params=[200, 100])
pixel = camera.img_from_cam(numpy.array([[0.0, 0.0, 1.0]]))
assert abs(pixel - [[100, 50]]).max() < 1e-6, pixel
model = pycolmap.Reconstruction()
model.add_camera_with_trivial_rig(camera)
print(json.dumps({"version": pycolmap.__version__, "cuda": bool(pycolmap.has_cuda)}))
"""

_OPENCV = """
import json
import cv2, numpy
picture = numpy.full((32, 64, 3), 100, numpy.uint8)
missing = []
for suffix, kind in ((".jpg", numpy.uint8), (".png", numpy.uint8), (".tiff", numpy.float32), (".webp", numpy.uint8)):
    good, data = cv2.imencode(suffix, picture.astype(kind))
    if not good or cv2.imdecode(data, cv2.IMREAD_UNCHANGED) is None:
        missing.append(suffix.lstrip("."))
backends = [cv2.videoio_registry.getBackendName(number) for number in cv2.videoio_registry.getBackends()]
said = {"version": cv2.__version__, "missing": missing, "video": "FFMPEG" in backends,
        "avif": bool(cv2.haveImageWriter("a.avif"))}
print(json.dumps(said))
"""

_PYVISTA = """
import json
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.set_background("black")
plotter.add_mesh(pyvista.Sphere(), color="white")
picture = plotter.screenshot(return_img=True)
plotter.close()
assert picture.max() > 100, "the picture is black"
print(json.dumps({"version": pyvista.__version__}))
"""

_TORCH = """
import json
import torch
count = torch.cuda.device_count() if torch.cuda.is_available() else 0
names = [f"{torch.cuda.get_device_name(k)}, {torch.cuda.get_device_properties(k).total_memory / 1e9:.0f} GB"
         for k in range(count)]
if count:
    assert float(torch.ones(8, device="cuda").sum()) == 8
print(json.dumps({"version": torch.__version__, "devices": names, "built_for": torch.version.cuda}))
"""


def run_probe(code: str, *, timeout_s: float = TIMEOUT_S) -> Outcome:
    """Run some code in a process of its own; the last line that it prints is a JSON object."""
    command = [sys.executable, "-P", "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)  # noqa: S603
    except subprocess.TimeoutExpired:
        return Outcome(None, f"gave no answer within {timeout_s:.0f} s")
    except OSError as error:
        return Outcome(None, f"could not be tried: {error}")
    lines = done.stdout.strip().splitlines()
    if done.returncode == 0 and lines:
        return Outcome(json.loads(lines[-1]))
    if done.returncode < 0:
        return Outcome(None, f"the process died of signal {-done.returncode}")
    return Outcome(None, (done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1])


def library_findings(attempt: Try | None = None, *, has_torch_plugin: bool | None = None) -> Iterator[Finding]:
    """Yield how the compiled libraries work.

    Args:
        attempt: runs a probe; by default in a process of its own.
        has_torch_plugin: whether the sweep on PyTorch is installed; looked up by default.
    """
    if has_torch_plugin is None:
        has_torch_plugin = importlib.util.find_spec("pano_mvs_torch") is not None
    readers: dict[str, Callable[[Outcome], Iterator[Finding]]] = {
        _NUMBA: _read_numba, _PYCOLMAP: _read_pycolmap, _OPENCV: _read_opencv, _PYVISTA: _read_pyvista
    }  # fmt: skip
    if has_torch_plugin:
        readers[_TORCH] = _read_torch
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(attempt or run_probe, readers))
    for read, outcome in zip(readers.values(), outcomes, strict=True):
        yield from read(outcome)
    if not has_torch_plugin:
        yield _finding("torch", "note", "the sweep on PyTorch (graphics cards) is not installed, nor needed",
                       "pip install ./plugins/pano_mvs_torch in a checkout")  # fmt: skip


def _finding(what: str, state: State, detail: str, remedy: str = "") -> Finding:
    return Finding("libraries", what, state, detail, remedy)


def _read_numba(outcome: Outcome) -> Iterator[Finding]:
    said = outcome.said
    if said is None:
        yield _finding("numba", "failed", outcome.why, f"{_PIP} numba llvmlite")
    elif said["disabled"]:
        yield _finding("numba", "warning", "compiles nothing: hundreds of times slower", "unset NUMBA_DISABLE_JIT")
    else:
        yield _finding("numba", "ok", f"{said['version']}, compiles")


def _read_pycolmap(outcome: Outcome) -> Iterator[Finding]:
    if outcome.said is None:
        yield _finding("pycolmap", "failed", outcome.why, f"{_PIP} pycolmap")
    else:
        yield _finding("pycolmap", "ok", f"{outcome.said['version']}, knows EQUIRECTANGULAR cameras")


def _read_opencv(outcome: Outcome) -> Iterator[Finding]:
    said = outcome.said
    if said is None:
        yield _finding("OpenCV", "failed", outcome.why, f"{_PIP} opencv-python-headless")
        return
    if said["missing"]:
        yield _finding("OpenCV", "failed", f"{said['version']} lacks {', '.join(said['missing'])}",
                       f"{_PIP} opencv-python-headless")  # fmt: skip
    else:
        video, avif = ("yes" if said[what] else "no" for what in ("video", "avif"))
        yield _finding("OpenCV", "ok", f"{said['version']}: JPEG, PNG, TIFF, WebP; AVIF: {avif}, video: {video}")
    if not said["video"]:
        yield _finding("OpenCV video", "warning", "reads no videos (no FFmpeg)", f"{_PIP} opencv-python-headless")
    if not said["avif"]:
        yield _finding("OpenCV AVIF", "note", "reads no AVIF pictures", "pip install -U opencv-python-headless")


def _read_pyvista(outcome: Outcome) -> Iterator[Finding]:
    if outcome.said is not None:
        yield _finding("PyVista", "ok", f"{outcome.said['version']}, draws without a screen")
        return
    remedy = "install the system's OpenGL libraries (Debian, Ubuntu: apt install libgl1 libegl1), or pip install -U vtk"
    yield _finding("PyVista", "warning", f"draws no pictures of clouds ({outcome.why}); all else works", remedy)


def _read_torch(outcome: Outcome) -> Iterator[Finding]:
    said = outcome.said
    if said is None:
        yield _finding("torch", "warning", outcome.why, "reinstall torch, or sweep with `backend: numba`")
    elif said["devices"]:
        yield _finding("torch", "ok", f"{said['version']}: {'; '.join(said['devices'])}")
    else:
        why = "built without CUDA" if said["built_for"] is None else f"built for CUDA {said['built_for']}"
        yield _finding("torch", "note", f"{said['version']}, {why}, finds no graphics card: backend torch uses the CPU",
                       "install the card's driver and a build of torch with CUDA")  # fmt: skip
