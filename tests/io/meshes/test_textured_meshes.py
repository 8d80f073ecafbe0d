"""GLB and OBJ files of textured meshes as trimesh reads them, and USDZ as Pixar's library does."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from pxr import Ar, Usd, UsdGeom, UsdShade

from pano_mvs.core.errors import UsageError
from pano_mvs.io.meshes import (
    TexturedArrays,
    TextureFormat,
    encoded_texture,
    write_glb,
    write_mtl,
    write_obj,
    write_usdz,
)
from tests.algorithms.mesh.box import box


def arrays() -> TexturedArrays:
    vertices, faces, _ = box(2)
    uv = np.random.default_rng(1).random((len(vertices), 2)).astype(np.float32)
    return TexturedArrays(vertices, uv, faces)


def texture() -> NDArray[np.uint8]:
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:24, :32], picture[:24, 32:], picture[24:] = (250, 10, 10), (10, 250, 10), (10, 10, 250)
    return picture


@pytest.mark.parametrize("form", ["png", "jpeg"])
def test_another_program_reads_the_glb(tmp_path: Path, form: TextureFormat) -> None:
    mesh = arrays()
    write_glb(tmp_path / "a.glb", mesh, encoded_texture(texture(), form, quality=95), form=form)
    read = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    assert isinstance(read, trimesh.Trimesh)
    np.testing.assert_array_equal(read.vertices.astype(np.float32), mesh.positions)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    visual = read.visual
    assert isinstance(visual, trimesh.visual.TextureVisuals)
    np.testing.assert_allclose(visual.uv, np.column_stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]]), atol=1e-6)
    assert isinstance(visual.material, trimesh.visual.material.PBRMaterial)
    picture = np.asarray(visual.material.baseColorTexture.convert("RGB"))
    assert np.abs(picture.astype(int) - texture()).mean() < (4 if form == "jpeg" else 1e-9)
    assert visual.material.doubleSided


@pytest.mark.parametrize("form", ["png", "jpeg"])
def test_the_library_of_pixar_reads_the_usdz(tmp_path: Path, form: TextureFormat) -> None:
    mesh, path = arrays(), tmp_path / "a.usdz"
    write_usdz(path, mesh, encoded_texture(texture(), form, quality=95), form=form)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    surface = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("surface"))
    np.testing.assert_array_equal(np.array(surface.GetPointsAttr().Get()), mesh.positions)
    np.testing.assert_array_equal(np.array(surface.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), mesh.faces)
    np.testing.assert_array_equal(np.array(surface.GetExtentAttr().Get())[0], mesh.positions.min(axis=0))
    uv = np.array(UsdGeom.PrimvarsAPI(surface).GetPrimvar("st").Get())
    np.testing.assert_allclose(uv, np.column_stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]]), atol=1e-6)
    material, _ = UsdShade.MaterialBindingAPI(surface).ComputeBoundMaterial()
    shader = material.ComputeSurfaceSource()[0]
    (source,) = shader.GetInput("emissiveColor").GetConnectedSources()[0]
    file = UsdShade.Shader(source.source).GetInput("file").Get()
    with Ar.GetResolver().OpenAsset(Ar.ResolvedPath(file.resolvedPath)) as asset:
        picture = np.asarray(Image.open(io.BytesIO(bytes(asset.GetBuffer()))).convert("RGB"))
    assert np.abs(picture.astype(int) - texture()).mean() < (4 if form == "jpeg" else 1e-9)


def test_the_usdz_is_an_aligned_archive_and_always_the_same(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_usdz(tmp_path / f"{name}.usdz", arrays(), encoded_texture(texture(), "png", quality=95), form="png")
    assert (tmp_path / "a.usdz").read_bytes() == (tmp_path / "b.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        assert archive.testzip() is None
        data = (tmp_path / "a.usdz").read_bytes()
        for entry in archive.infolist():
            assert entry.compress_type == zipfile.ZIP_STORED
            assert data.index(archive.read(entry)) % 64 == 0


def test_the_box_stays_watertight(tmp_path: Path) -> None:
    """Its walls have their own vertices, at common places."""
    write_glb(tmp_path / "a.glb", arrays(), encoded_texture(texture(), "png", quality=95), form="png")
    read = trimesh.load(tmp_path / "a.glb", force="mesh")
    assert isinstance(read, trimesh.Trimesh)
    read.merge_vertices(merge_tex=True, merge_norm=True)
    assert read.is_watertight
    assert read.is_winding_consistent


def test_another_program_reads_the_obj_and_its_files(tmp_path: Path) -> None:
    mesh = arrays()
    write_obj(tmp_path / "a.obj", mesh, material_file="a.mtl")
    write_mtl(tmp_path / "a.mtl", texture_file="a.png")
    (tmp_path / "a.png").write_bytes(encoded_texture(texture(), "png", quality=95))
    read = trimesh.load(tmp_path / "a.obj", force="mesh", process=False, maintain_order=True)
    assert isinstance(read, trimesh.Trimesh)
    np.testing.assert_allclose(read.vertices, mesh.positions, rtol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    visual = read.visual
    assert isinstance(visual, trimesh.visual.TextureVisuals)
    np.testing.assert_allclose(visual.uv, np.column_stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]]), atol=1e-6)
    np.testing.assert_array_equal(np.asarray(visual.material.image.convert("RGB")), texture())


def test_a_texture_too_large_for_its_format_is_refused() -> None:
    with pytest.raises(UsageError, match=r"a texture of 65600×1 px cannot be written as jpeg"):
        encoded_texture(np.zeros((1, 65_600, 3), np.uint8), "jpeg", quality=90)
