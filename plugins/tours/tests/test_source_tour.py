"""Virtual tours of cube tiles are read as panoramas, whatever program wrote them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_tours.source import TourParams, list_tour, tour
from pano_mvs_tours.tour_folders import is_tour, list_scenes

from pano_mvs.algorithms.faces.sampling import CUBE
from pano_mvs.core.errors import InputError, WorkflowError
from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import ray_grid
from pano_mvs.session.session import open_session
from tests.synthetic.tour_files import LAYOUTS, NAMES, color_of, face_of, write, write_tour


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scenes_become_panoramas_with_the_front_in_the_middle(tmp_path: Path, layout: str) -> None:
    params = TourParams.model_validate({"path": write_tour(tmp_path / "tour", layout)})
    items = list(list_tour(params))
    assert [Path(item.name).stem.removesuffix(".tiles") for item in items] == ["1-hall", "2-room"]
    assert all(len(item.files) == 24 for item in items), "the finest level has four tiles in each face"
    for number, item in enumerate(items):
        scratch = tmp_path / str(number)
        scratch.mkdir()
        panorama = tour(item, params, Context(np.random.default_rng(0), scratch, 1))
        panorama.check()
        assert panorama.size_hw == (128, 256)
        difference = panorama.load().astype(int) - color_of(ray_grid((128, 256)), number)
        assert np.abs(difference).max() <= 6
        assert np.abs(difference).mean() < 1


@pytest.mark.parametrize("form", ["{scene}_{face}", "{scene}/{face}", "{scene}/{name}", "tiles/{scene}.{name}"])
def test_six_files_are_a_scene(tmp_path: Path, form: str) -> None:
    for number, scene in enumerate(("hall", "room")):
        for face in CUBE:
            path = tmp_path / f"{form.format(scene=scene, face=face, name=NAMES[face])}.png"
            write(path, face_of(face, number))
    (tmp_path / "thumbnail.png").touch()
    scenes = list_scenes(tmp_path, [])
    assert [scene.name for scene in scenes] == ["hall", "room"]
    assert {tile[0] for tile in scenes[0].tiles} == set(CUBE)


def test_scenes_without_a_whole_cube_are_named(tmp_path: Path) -> None:
    write_tour(tmp_path, "Pannellum", ("1", "2", "3"))
    (tmp_path / "tour/2/2/u1_1.png").unlink()
    notes: list[str] = []
    assert [scene.name for scene in list_scenes(tmp_path, notes)] == ["1", "3"]
    assert notes == ["1 scenes have no complete cube and are skipped: tour/2"]
    (tmp_path / "tour/1/2/f0_0.png").unlink()
    with pytest.raises(InputError, match=r"only one scene \(3\)|contains only one scene"):
        list(list_tour(TourParams.model_validate({"path": tmp_path})))


def test_a_folder_without_cubes_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.png", face_of("f"))
    with pytest.raises(InputError, match=r"no tour here\. Six faces of a cube are needed"):
        list_scenes(tmp_path, [])


def test_tiles_that_do_not_fit_together_are_named(tmp_path: Path) -> None:
    write_tour(tmp_path, "Pannellum")
    write(tmp_path / "tour/1-hall/2/r0_1.png", face_of("r")[:20, :20])
    params = TourParams.model_validate({"path": tmp_path})
    (tmp_path / "scratch").mkdir()
    with pytest.raises(InputError, match=r"do not fit together|not squares of one size"):
        tour(next(iter(list_tour(params))), params, Context(np.random.default_rng(0), tmp_path / "scratch", 1))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_preset_reads_the_scenes_of_a_tour_that_it_is_given(tmp_path: Path, layout: str) -> None:
    folder = write_tour(tmp_path / "tour", layout)
    write(folder / "img/expand.png", face_of("f"))
    session = open_session("quickstart", images=folder)
    stage = session.workflow.stages["images"]
    assert stage.spec.name == "source.tour"
    assert isinstance(stage.params, TourParams)
    notes = next(iter(list_tour(stage.params))).notes
    assert notes == ("2 scenes of a virtual tour are read",)


def test_a_tour_keeps_the_settings_that_both_sources_have(tmp_path: Path) -> None:
    folder = write_tour(tmp_path / "tour", "Marzipano")
    session = open_session("fast", images=folder, overrides=["images.nadir_deg=25"])
    params = session.workflow.stages["images"].params
    assert isinstance(params, TourParams)
    assert (params.path, params.max_width, params.nadir_deg) == (folder, 1024, 25.0)
    with pytest.raises(WorkflowError, match="mask_folder") as caught:
        open_session("fast", images=folder, overrides=["images.mask_folder=x"])
    assert "source.tour" not in str(caught.value), "nobody has named it"


def test_a_workflow_without_a_stage_of_images_gets_one_error(tmp_path: Path) -> None:
    folder = write_tour(tmp_path / "tour", "Marzipano")
    workflow = tmp_path / "own.yaml"
    workflow.write_text(f"pano_mvs: 1\nstages:\n  pictures: {{use: source.folder, path: {folder}}}\n")
    with pytest.raises(WorkflowError, match="no stage called 'images'") as caught:
        open_session(workflow, images=folder)
    assert "source.tour" not in str(caught.value)


def test_panoramas_are_not_taken_for_a_tour(tmp_path: Path) -> None:
    """Names of dates may look like tiles, and a folder of panoramas may also hold a tour that was made of them."""
    for name in ("d3_01", "d3_02", "f4_01"):
        write(tmp_path / f"dates/12/{name}.png", face_of("f"))
    assert not is_tour(tmp_path / "dates")
    folder = write_tour(tmp_path / "tour", "Marzipano")
    assert is_tour(folder)
    write(folder / "plan.png", face_of("f"))
    assert is_tour(folder)
    write(folder / "panorama.png", np.tile(face_of("f"), (1, 2, 1)))
    assert not is_tour(folder)
    write_tour(tmp_path / "one", "Marzipano", ("hall",))
    assert not is_tour(tmp_path / "one")


def test_a_named_source_and_plain_pictures_are_not_taken_for_a_tour(tmp_path: Path) -> None:
    folder = write_tour(tmp_path / "tour", "Marzipano")
    session = open_session("quickstart", images=folder, overrides=["images.use=source.folder"])
    assert session.workflow.stages["images"].spec.name == "source.folder"
    for face in CUBE:
        write(tmp_path / f"faces/hall_{face}.png", face_of(face))
    assert not is_tour(tmp_path / "faces")
    assert not is_tour(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("tour.xml", '<krpano><scene name="hall" onstart="if(a && b, c);"/></krpano>'),
        ("tour.xml", '<krpano><scene name="hall" title="a < b"/></krpano>'),
        ("tour.json", '{"scenes": {"hall": }'),
    ],
)
def test_a_configuration_that_cannot_be_read_is_named(tmp_path: Path, file: str, text: str) -> None:
    """source.folder said of each face that it is no full sphere, and advised to set `stereo`."""
    (tmp_path / file).write_text(text)
    for scene in ("hall", "room"):
        for face in CUBE:
            write(tmp_path / f"{scene}_{face}.png", face_of(face))
    told = rf"{file}: not used as the configuration of a tour.* Correct the file, or .*images\.use=source\.tour"
    with pytest.raises(InputError, match=told):
        open_session("quickstart", images=tmp_path)
    items = list(list_tour(TourParams.model_validate({"path": tmp_path})))
    assert [item.name for item in items] == ["hall.png", "room.png"]
    assert re.search(f"{file}: not used", items[0].notes[0])
    write(tmp_path / "panorama.png", np.tile(face_of("f"), (1, 2, 1)))
    assert not is_tour(tmp_path), "pictures of a house may lie beside its panoramas"


SKYBOX = dict(zip("ufrbld", range(6), strict=True))


@pytest.mark.parametrize("form", ["{scene}_skybox{number}_sami.png", "{scene}/skybox{number}.png"])
@pytest.mark.parametrize("turned", [False, True])
def test_skyboxes_of_matterport_are_read(tmp_path: Path, form: str, turned: bool) -> None:
    """0 is up, 1 to 4 follow each other to the right, 5 is down; the edges of u and d lie at 1. Others are turned."""
    uuids = ("0f37bd0737e349de9d536263a4bdd60d", "1e6b606b44df4a6086c0f97e826d4d15")
    for number, uuid in enumerate(uuids):
        for face in CUBE:
            picture = np.rot90(face_of(face, number), turned and face in "ud")
            write(tmp_path / "skyboxes" / form.format(scene=uuid, number=SKYBOX[face]), np.ascontiguousarray(picture))
    folder = tmp_path / "skyboxes"
    assert is_tour(folder) is form.endswith("sami.png")
    items = list(list_tour(TourParams.model_validate({"path": folder})))
    assert [item.name for item in items] == [f"{uuid}.png" for uuid in uuids]
    context = Context(np.random.default_rng(0), tmp_path, 1)
    panorama = tour(items[0], TourParams.model_validate({"path": folder}), context)
    difference = panorama.load().astype(int) - color_of(ray_grid((128, 256)), 0)
    assert np.abs(difference).max() <= 6
    assert any("did not fit together" in note for note in context.notes) is turned


@pytest.mark.parametrize(("name", "rig"), [("VID_1.insv", True), ("GS010001.360", False)])
def test_recordings_that_are_not_stitched_say_so(tmp_path: Path, name: str, rig: bool) -> None:
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=rf"{name}, which a camera .* recorded .*Export it as") as caught:
        list_scenes(tmp_path, [])
    assert ("source.dual_fisheye" in str(caught.value)) == rig
