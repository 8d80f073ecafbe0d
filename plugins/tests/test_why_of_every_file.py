"""`pano-mvs why` answers for every kind of file that is written: by exporters, runs, experiments and shared pages."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import pano_mvs as package
from pano_mvs.core.errors import InputError
from pano_mvs.engine.stages.registry import Registry
from tests.cli.conftest import SMALL, Command, finished, finished_once, pano_mvs, rendered, toy
from tests.engine.conftest import Toy

__all__ = ["finished", "finished_once", "pano_mvs", "rendered", "toy"]

EXPORTS = """\
pano_mvs: 1
name: all
extends: quickstart
stages:
  exports:
    stages:
      colmap:       {format: both}
      masks_colmap: {use: export.colmap_masks}
      faces:        {use: export.colmap_faces}
      samples:      {use: points.surface}
      tracked:      {use: points.tracked, count: 2000}
      dense:        {use: export.colmap_dense}
      dense_init:   {use: export.colmap_dense_init}
      mesh:         {use: export.mesh, depth: 5}
      textured:     {use: export.mesh_textured, cell: 0.1, triangles: 1000, texture_px: 256}
      tiles:        {use: export.tiles_3d}
      poses_files:  {use: export.poses}
      panoramas:    {use: export.panoramas}
      tour:         {use: export.tour, players: [pannellum, marzipano, krpano]}
      plan:         {use: export.floor_plan}
      ns_frames:    {use: export.nerfstudio_frames}
      ns:           {use: export.nerfstudio}
      splat_frames: {use: export.splat_frames}
      bundle:       {use: export.splat_bundle, seed_points: 2000}
"""
# They need a two-lens camera, and the links of a virtual tour.
OF_OTHER_CAPTURES = {"export.colmap_lenses", "export.house"}


def files_below(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def files_of_each_kind(folder: Path) -> list[Path]:
    """Return the first and the last of the files in each folder that end in the same way."""
    kinds: dict[tuple[Path, str], list[Path]] = {}
    for path in files_below(folder):
        kinds.setdefault((path.parent, path.suffix), []).append(path)
    return [path for paths in kinds.values() for path in dict.fromkeys((paths[0], paths[-1]))]


@pytest.mark.slow
def test_why_answers_for_files_of_all_exporters_and_of_a_page(
    quickstart: tuple[Path, str], rendered: Path, pano_mvs: Command
) -> None:
    Path("all.yaml").write_text(EXPORTS)
    shutil.copytree(quickstart[0].with_name("cache"), "cache")  # what the exporters export was computed before
    done = pano_mvs("run", "all.yaml", "--images", rendered / "images", "--out", "out", "--cache", "cache", *SMALL)
    assert done.code in (0, 3), done.text
    summary = package.load("out").summary
    origins = {path: package.why(path) for path in files_of_each_kind(Path("out"))}
    made_by: set[str] = set()
    for path, origin in origins.items():
        assert origin.images, path
        if path.relative_to("out").as_posix() in summary.files:
            assert origin.units, path
            assert not origin.was_changed, path
            made_by.add(origin.units[0].use)
            assert origin.units[0].group == "exports", path
        else:
            assert "written by the run itself" in origin.notes[0], path
    exporters = {name for name in Registry.installed().stages if name.startswith("export.")}
    assert exporters - made_by == OF_OTHER_CAPTURES
    # Unchanged copies are of the exporter that delivers them, not of the source or of another exporter.
    for folder, use in {"splat_bundle/faces/images": "export.splat_frames", "nerfstudio": "export.nerfstudio"}.items():
        inside = [path for path in origins if path.is_relative_to(Path("out") / folder)]
        assert inside
        assert all(origins[path].units[0].use.startswith(use) for path in inside)
    assert pano_mvs("share", "out", "--to", "page").code == 0
    for path in files_of_each_kind(Path("page")):
        origin = package.why(path)
        assert (origin.command, origin.out) == ("share", Path("out")), path
        assert len(origin.images) == 4, path
    assert "page.html: made by pano-mvs share from the run into out" in pano_mvs("why", "page/page.html").flat
    again = pano_mvs("why", "page/page.html", "--again")
    assert (again.code, "there is no unit to compute again: made from 1 run" in again.flat) == (2, True)


def test_files_of_an_experiment_lead_to_its_runs(toy: Toy, pano_mvs: Command) -> None:
    words = ["--cache", toy.folder / "cache", "--out", "v", "--executor", "serial"]
    assert pano_mvs("vary", toy.folder / "wf.yaml", "--set", "scaled.by=2,3", *words).code == 0
    runs = [Path("v/capture/by=2"), Path("v/capture/by=3")]
    for name in ("vary.json", "vary.csv", "vary.html"):
        origin = package.why(Path("v") / name)
        assert (origin.command, origin.workflow, origin.units) == ("vary", "toy", ())
        assert all(str(run) in origin.notes[0] for run in runs)
        assert len(origin.images) == len(list((toy.folder / "capture").iterdir()))
    for run in runs:
        for path in files_below(run):
            origin = package.why(path)
            assert (origin.command, origin.out.name) == ("", run.name)
            assert origin.units or "written by the run itself" in origin.notes[0]
    for run in runs:
        (run / "run.json").unlink()
    with pytest.raises(InputError, match=r"pano-mvs vary made this file, but no run that it was made from is in .*v"):
        package.why("v/vary.csv")
