"""Bodies from the files of other programs."""

import base64
import json
import zlib

import numpy as np
import pytest
from morphod import Body, BodyError, read_bodies
from morphod.imports import check_hashes

STAIRS = np.zeros((3, 2, 2), dtype=np.uint8)  # [x, y, z], of two materials
STAIRS[:, 0, 0] = 1
STAIRS[2, :, 1] = 3
STAIRS[2, 1, 0] = 3
# Two bodies, with the hashes that the program of the paper's authors computes.
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
    assert body.lost == ("materials 1, 3 were merged into one", )


def test_evogym(tmp_path):
    """Rows go upward in the file; an EvoGym array starts at the top."""
    file = tmp_path / "world.json"
    file.write_text(json.dumps({"grid_width": 10, "grid_height": 5, "objects": {
        "robot": {"indices": [12, 13, 14, 24], "types": [3, 3, 4, 4], "neighbors": {}},
        "box": {"indices": [37], "types": [1], "neighbors": {}}}}))
    robot, box = read_bodies(file)
    assert set(robot.cells) == {(x, y, 0) for x in range(3) for y in (2, 3)} | {(2, 2, 1),
                                                                               (2, 3, 1)}
    assert robot.lost == ("materials 3, 4 were merged into one", ) and len(box) == 2
    assert (robot.name, box.name) == ("robot", "box")


def world(**objects):
    return json.dumps({"grid_width": 20, "grid_height": 10, "objects": {
        name: dict(zip(("indices", "types", "neighbors"), parts))
        for name, parts in objects.items()}})


GROUND = ([*range(20)], [5] * 20)
ROBOT = ([41, 42, 61], [3, 3, 4])


def test_evogym_leaves_out_the_ground(tmp_path):
    file = tmp_path / "world.json"
    file.write_text(world(ground=GROUND, robot=ROBOT))
    robot, = read_bodies(file)
    assert set(robot.cells) == {(0, y, z) for y in (2, 3) for z in (0, 1)} | {(1, 2, 0), (1, 3, 0)}
    assert robot.lost == ("materials 3, 4 were merged into one",
                          "left out of the file: ground (fixed)")
    file.write_text(world(ground=GROUND))
    with pytest.raises(BodyError, match="this file has only fixed objects: ground"):
        read_bodies(file)


def test_evogym_objects_by_name(tmp_path):
    file = tmp_path / "world.json"
    bridge = ([*range(100, 115)], [2] * 15)
    file.write_text(world(ground=GROUND, robot=ROBOT, bridge=bridge, box=([81], [1])))
    with pytest.raises(BodyError, match="bridge: the body is 15 .* names= or on_fault"):
        read_bodies(file)
    assert [body.name for body in read_bodies(file, names=["box", "robot"])] == ["box", "robot"]
    assert read_bodies(file, "box")[0].lost == ("material 1 became morphod's only material", )
    with pytest.raises(BodyError, match="no body 'rob'; it has ground, robot, bridge and 1 more"):
        read_bodies(file, "rob")
    bodies = read_bodies(file, on_fault="skip")
    assert [body.name for body in bodies] == ["robot", "box"]
    assert bodies[1].lost[-1].startswith(
        "left out of the file: ground (fixed), bridge (the body is 15 voxels long on axis 0")


def test_evogym_voxels_that_are_apart(tmp_path):
    """41 and 42 touch 61 and each other; the file connects only 41 and 61."""
    file = tmp_path / "world.json"
    file.write_text(world(robot=([41, 42, 61], [3, 3, 3], {"41": [61], "61": [41]})))
    assert read_bodies(file)[0].lost[1:] == (
        "1 pair of adjacent voxels that was not connected is now connected", )
    file.write_text(world(robot=([41, 42], [3, 3], {"41": [42], "42": [41]})))
    assert len(read_bodies(file)[0].lost) == 1


def test_evogym_robots_of_numpy(tmp_path):
    """As EvoGym's examples save them: body and connections."""
    body, connections = np.array([[3.0, 3.0], [4.0, 0.0]]), np.array([[0, 0], [1, 2]])
    np.savez(tmp_path / "robot.npz", body, connections)
    robot, = read_bodies(tmp_path / "robot.npz")
    assert robot == Body.evogym(body) and robot.lost == ("materials 3, 4 were merged into one", )
    np.savez(tmp_path / "apart.npz", body, connections[:, :1])
    assert "not connected is now connected" in read_bodies(tmp_path / "apart.npz")[0].lost[1]
    np.savez(tmp_path / "high.npz", np.full((5, 5), 3.0), np.empty((2, 0)))
    with pytest.raises(BodyError, match="5 voxels high .axis 0 of the array.; the workspace has 4"):
        read_bodies(tmp_path / "high.npz")
    np.savez(tmp_path / "bodies.npz", first=POLYCUBES, second=POLYCUBES[1])
    bodies = read_bodies(tmp_path / "bodies.npz")
    assert [one.name for one in bodies] == ["first 0", "first 1", "second 0"]
    assert bodies[1] == bodies[2] == read_bodies(tmp_path / "bodies.npz", "second 0")[0]
    np.savez(tmp_path / "flat.npz", body)
    with pytest.raises(BodyError, match="arr_0 has 2 axes.* Body.evogym"):
        read_bodies(tmp_path / "flat.npz")


def test_pickles_are_not_run(tmp_path):
    class Program:
        def __reduce__(self):
            return (tmp_path.joinpath("ran").touch, ())

    for name in ("a.npy", "a.npz"):
        with open(tmp_path / name, "wb") as file:
            (np.save if name == "a.npy" else np.savez)(file, np.array([Program()], dtype=object))
        with pytest.raises(BodyError, match="cannot be read"):
            read_bodies(tmp_path / name)
    (tmp_path / "b.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(BodyError, match="cannot be read"):
        read_bodies(tmp_path / "b.npz")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("more, said", [
    ("<PhaseOffset><Layer><![CDATA[0.5]]></Layer></PhaseOffset>", "phase offsets"),
    ("<Stiffness><Layer><![CDATA[100000.0]]></Layer></Stiffness>", "stiffness"),
    ("<BaseCiliaForce><Layer><![CDATA[0.1,0,0]]></Layer></BaseCiliaForce>"
     "<ShiftCiliaForce><Layer><![CDATA[1,0,0]]></Layer></ShiftCiliaForce>", "cilia"),
    ("<PhaseOffset><Layer>1</Layer></PhaseOffset><CiliaForce>1</CiliaForce>",
     "phase offsets, cilia"),
    ("<FinalVoxelSize><Layer>0.01</Layer></FinalVoxelSize>", "FinalVoxelSize"),
    ("<PhaseOffset><Layer>0.0, 0.0</Layer></PhaseOffset>", None),
])
def test_what_voxcraft_loses(tmp_path, more, said):
    file = tmp_path / "robot.vxd"
    file.write_text(vxd("ASCII_READABLE", ["1"], (1, 1, 1)).replace("</Data>", "</Data>" + more))
    assert read_bodies(file)[0].lost == ((f"left out of the file: {said}", ) if said else ())


def test_what_the_palette_of_voxcraft_loses(tmp_path):
    file = tmp_path / "robot.vxa"
    palette = ('<Palette><Material ID="1"><Mechanical><Cilia>1</Cilia><Elastic_Mod>1e5'
               "</Elastic_Mod></Mechanical></Material></Palette>")
    file.write_text(vxd("ASCII_READABLE", ["1"], (1, 1, 1)).replace("<VXD>", "<VXD>" + palette))
    assert read_bodies(file)[0].lost == ("left out of the file: stiffness, cilia", )
    more = palette.replace("<Elastic_Mod>", "<CTE>0.01</CTE><Density>1e6</Density><uDynamic>0.5"
                           "</uDynamic><uStatic>0</uStatic><Elastic_Mod>")
    file.write_text(vxd("ASCII_READABLE", ["1"], (1, 1, 1)).replace("<VXD>", "<VXD>" + more))
    assert read_bodies(file)[0].lost == (
        "left out of the file: stiffness, cilia, density, friction, thermal expansion", )


def test_populations(tmp_path):
    np.save(tmp_path / "polycubes.npy", POLYCUBES.reshape(1, 2, 6, 6, 4))
    bodies = read_bodies(tmp_path / "polycubes.npy")
    assert [body.cells for body in bodies] == [
        [tuple(cell) for cell in np.argwhere(polycube)] for polycube in POLYCUBES]
    assert (check_hashes(POLYCUBES, HASHES) == POLYCUBES).all()
    with pytest.raises(BodyError, match="body 0 does not match its hash"):
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
    ("a.vxd", vxd("ASCII_READABLE", ["1"], (1, 10**9, 1)), "must be 1 to 1000"),
    ("a.vxd", vxd("ZLIB", [based(zlib.compress(bytes(10**7)))], (1, 1, 1)), "2 voxels"),
    ("a.vxd", vxd("ZLIB", ["AAAA"], (1, 1, 1)), "not ZLIB"),
    ("a.vxd", vxd("BASE64", ["?"], (1, 1, 1)), "not BASE64"),
    ("a.vxd", vxd("RAW_DATA", ["AQ=="], (1, 1, 1)), "RAW_DATA cannot be read"),
    ("a.vxd", "<VXD></VXD>", "no Structure"),
    ("a.vxd", "VXD", "not XML"),
    ("a.json", "{}", "not an EvoGym world"),
    ("a.json", '{"grid_width": 9, "objects": {"wide": {"indices": [0, 8], "types": [1, 1]}}}',
     "wide: the body is 9 voxels long on axis 0 (x)"),
    ("a.json", '{"grid_width": 1, "objects": {"a": {"indices": [0, 9e15], "types": [1, 1]}}}',
     "too large"),
    ("a.json", "{", "is not JSON"),
    ("a.json", world(a=([0, 0.5], [1, 1])), "indices are not whole numbers"),
    ("a.json", world(a=([0, 0], [1, 1])), "negative or duplicate"),
    ("a.json", world(a=([0], [7])), "is 7: EvoGym materials are 0"),
    ("a.vxd", vxd("ASCII_READABLE", ["a"], (1, 1, 1)), "characters other than digits"),
    ("a.txt", "", "not a file of bodies"),
])
def test_errors_name_what_is_wrong(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    with pytest.raises(BodyError) as caught:
        read_bodies(tmp_path / name)
    assert said in str(caught.value)
