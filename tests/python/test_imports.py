"""Bodies from the files of other programs."""

import base64
import json
import zlib

import numpy as np
import pytest
from morphod import BodyError, read_bodies
from morphod.imports import check_hashes

STAIRS = np.zeros((3, 2, 2), dtype=np.uint8)  # [x, y, z], of two materials
STAIRS[:, 0, 0] = 1
STAIRS[2, :, 1] = 3
STAIRS[2, 1, 0] = 3
# Two bodies with the hashes that the paper's authors' program gives them.
POLYCUBES = np.zeros((2, 6, 6, 4), dtype=np.uint8)
POLYCUBES[0, 1:4, 2, 0] = POLYCUBES[0, 3, 3, 0:2] = 1
POLYCUBES[1, 0:2, 0:3, 0] = 1
HASHES = ["560547b804317fe7b251b5b4c40da3b5bd9f19c87c5025eade41c2f9a9640bf3",
          "2ed31396d655116915c68ea9ff45e3594e67b22d695b350c7287cffe86877903"]


def vxd(compression, layers, sides=STAIRS.shape):
    voxels = "".join(f"<{name}_Voxels>{side}</{name}_Voxels>" for name, side in zip("XYZ", sides))
    data = "".join(f"<Layer><![CDATA[{layer}]]></Layer>" for layer in layers)
    return (f'<VXD><Structure replace="VXA.VXC.Structure" Compression="{compression}">{voxels}'
            f"<Data>{data}</Data></Structure></VXD>")


def layers_of(array, how):
    return [how(bytes(array[:, :, z].T.ravel())) for z in range(array.shape[2])]


def based(content):
    return base64.b64encode(content).decode()


LAYERS = {
    "ASCII_READABLE": lambda raw: "".join(str(value) for value in raw),
    "BASE64": based,
    "ZLIB": lambda raw: based(zlib.compress(raw)),
    "QT_ZLIB": lambda raw: based(len(raw).to_bytes(4, "big") + zlib.compress(raw)),
}


@pytest.mark.parametrize("compression", LAYERS)
def test_voxcraft(tmp_path, compression):
    file = tmp_path / "robot.vxd"
    file.write_text(vxd(compression, layers_of(STAIRS, LAYERS[compression])))
    body, = read_bodies(file)
    assert set(body.cells) == {tuple(cell) for cell in np.argwhere(STAIRS)}
    assert body.lost == ("materials 1, 3 became one", )


def test_evogym(tmp_path):
    """Rows go upwards in the file; an array of EvoGym has its top first."""
    file = tmp_path / "world.json"
    file.write_text(json.dumps({"grid_width": 10, "grid_height": 5, "objects": {
        "robot": {"indices": [12, 13, 14, 24], "types": [3, 3, 4, 4], "neighbors": {}},
        "box": {"indices": [37], "types": [1], "neighbors": {}}}}))
    robot, box = read_bodies(file)
    assert set(robot.cells) == {(x, y, 0) for x in range(3) for y in (2, 3)} | {(2, 2, 1),
                                                                               (2, 3, 1)}
    assert robot.lost == ("materials 3, 4 became one", ) and len(box) == 2


def test_populations(tmp_path):
    np.save(tmp_path / "polycubes.npy", POLYCUBES.reshape(1, 2, 6, 6, 4))
    bodies = read_bodies(tmp_path / "polycubes.npy")
    assert [body.cells for body in bodies] == [
        [tuple(cell) for cell in np.argwhere(polycube)] for polycube in POLYCUBES]
    assert (check_hashes(POLYCUBES, HASHES) == POLYCUBES).all()
    with pytest.raises(BodyError, match="body 0 has another hash"):
        check_hashes(POLYCUBES.transpose(0, 3, 2, 1), HASHES)
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "population.h5", "w") as file:
        file["robots/polycubes"] = POLYCUBES
        file["robots/pc_hashes"] = HASHES
    assert read_bodies(tmp_path / "population.h5") == bodies
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["bodies"] = POLYCUBES
    with pytest.raises(BodyError, match="no robots/polycubes"):
        read_bodies(tmp_path / "other.h5")


@pytest.mark.parametrize("name, content, said", [
    ("a.vxd", vxd("ASCII_READABLE", ["1" * 7], (7, 1, 1)), "7 voxels long on axis 0 (x)"),
    ("a.vxa", vxd("ASCII_READABLE", ["1"] * 5, (1, 1, 5)), "axis 2 (z)"),
    ("a.vxd", vxd("ASCII_READABLE", ["11"], (1, 1, 1)), "a layer has 2 voxels"),
    ("a.vxd", vxd("ASCII_READABLE", ["1"], (1, 1, 2)), "1 layers for Z_Voxels = 2"),
    ("a.vxd", vxd("ASCII_READABLE", ["1"], (1, 10**9, 1)), "are not 1 to 1000"),
    ("a.vxd", vxd("ZLIB", [based(zlib.compress(bytes(10**7)))], (1, 1, 1)), "2 voxels"),
    ("a.vxd", vxd("ZLIB", ["AAAA"], (1, 1, 1)), "not ZLIB"),
    ("a.vxd", vxd("BASE64", ["?"], (1, 1, 1)), "not BASE64"),
    ("a.vxd", vxd("RAW_DATA", ["AQ=="], (1, 1, 1)), "RAW_DATA cannot be read"),
    ("a.vxd", "<VXD></VXD>", "no Structure"),
    ("a.vxd", "VXD", "not XML"),
    ("a.json", "{}", "not a world of EvoGym"),
    ("a.json", '{"grid_width": 9, "objects": {"wide": {"indices": [0, 8], "types": [1, 1]}}}',
     "wide: the body is 9 voxels long on axis 0 (x)"),
    ("a.json", '{"grid_width": 1, "objects": {"a": {"indices": [0, 9e15], "types": [1, 1]}}}',
     "too large"),
    ("a.txt", "", "not a file of bodies"),
])
def test_errors_name_what_is_wrong(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    with pytest.raises(BodyError) as caught:
        read_bodies(tmp_path / name)
    assert said in str(caught.value)
