"""Systems from files: what is read, what is refused, and how a file that changes is noticed."""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import tracemalloc
from pathlib import Path

import distributed.system
import numpy as np
import pytest
import scipy.io
import scipy.sparse

from stickslip import sim
from stickslip.pipeline import SceneError, StoreError, expand, load_scene, query, run_ensemble, verify
from stickslip.pipeline.ensemble.pack import tasks
from stickslip.pipeline.scene import systems
from stickslip.pipeline.scene.scene import parse_scene
from stickslip.pipeline.scene.system_table import FileTable
from stickslip.workflows.commands import main
from tests.scenes import ENDING

SCENE = (
    """\
[system]
coupling = "file"
path = "K.npz"
n = 4
rho = 3.5
belt_speed = [-0.1, -0.2]
[start]
z = "file"
w = {uniform = [-0.3, 0.1]}
draws = 2
[run]
t_end = 5.0
matrices = 2
"""
    + ENDING
)


@pytest.fixture
def arrays(rng):
    """A file's content: K of four blocks, not symmetric, and what it may hold beside."""
    stiffness = rng.uniform(-0.2, 0.2, (4, 4)) + np.diag(rng.uniform(1.0, 2.0, 4))
    return {"stiffness": stiffness, "friction": rng.uniform(0.8, 1.2, 4), "z0": rng.uniform(-1, 1, 4)}


def written(folder, arrays, text=SCENE):
    np.savez(folder / "K.npz", **arrays)
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


def test_a_file_is_the_system_and_its_digest_is_in_the_name(tmp_path, arrays):
    members = expand(load_scene(written(tmp_path, arrays)))
    assert len(members) == 2 * 2 * 2
    assert len({member.member_id for member in members}) == len(members)
    sha256 = members[0].source.origin.sha256
    assert all(member.member_id.startswith(f"n4-K{sha256[:12]}-m00") for member in members)
    for member in members:
        system = member.system()
        assert np.array_equal(system.stiffness, arrays["stiffness"])
        assert np.array_equal(system.friction, arrays["friction"])
        assert (system.damping >= 3.5).all()
        assert np.array_equal(member.start()[0], arrays["z0"])
        assert member.drawn == "friction = file; z = file; w = uniform(-0.3, 0.1)"
    assert len({member.system().damping.tobytes() for member in members}) == 2  # a draw for each of `matrices`


def test_a_scene_of_files_may_leave_n_out(tmp_path, arrays):
    """It is the same scene, and `n` is required of all others."""
    said = load_scene(written(tmp_path, arrays))
    left = load_scene(written(tmp_path, arrays, SCENE.replace("n = 4\n", "")))
    assert left.system.n == (4,)
    assert left.hash == said.hash == left.from_source.hash
    assert "n = 4" not in left.source.partition("[system.files")[0]
    np.savez(tmp_path / "L.npz", stiffness=np.eye(3), z0=np.zeros(3))
    both = left.changed(system={"path": "[KL].npz"})
    assert [member.n for member in expand(both)[::8]] == [3, 4]
    with pytest.raises(SceneError, match=r"system\.n: expected the number of blocks.* add `n = 200`"):
        load_scene(written(tmp_path, arrays, SCENE.replace('"file"\npath = "K.npz"\nn = 4', '"chain"')))


def test_the_run_of_a_member_is_that_of_simulate(tmp_path, arrays):
    file = written(tmp_path, arrays)
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out")
    assert set(table.file) == {"K.npz"}
    assert table.kappa.unique() == pytest.approx([np.abs(arrays["stiffness"]).max()])
    assert table.friction.isna().all()
    member = expand(load_scene(file))[-1]
    system = sim.System(arrays["stiffness"], member.system().damping, arrays["friction"], member.term("belt_speed"))
    run = sim.simulate(system, *member.start(), t_end=5.0, tol=1e-6)
    row = table.set_index("member_id").loc[member.member_id]
    assert (row.outcome, row.n_events, row.n_steps) == (run.outcome, run.stats.n_events, run.stats.n_steps)


def test_all_formats_hold_the_same_system(tmp_path, arrays):
    k = arrays["stiffness"] * (np.abs(arrays["stiffness"]) > 0.1)
    sparse = scipy.sparse.csc_array(k)
    np.save(tmp_path / "a.npy", k)
    np.savez(tmp_path / "b.npz", anything=k)
    np.savez(tmp_path / "c.npz", stiffness=k)
    scipy.sparse.save_npz(tmp_path / "d.npz", sparse)
    scipy.sparse.save_npz(tmp_path / "e.npz", scipy.sparse.csr_array(k))
    scipy.io.mmwrite(tmp_path / "f.mtx", sparse)
    file = tmp_path / "mine.toml"
    file.write_text(SCENE.replace("K.npz", "[a-f].*").replace('"file"\nw', "0.0\nw"))
    found = {member.source.origin.name: member.system() for member in expand(load_scene(file))}
    assert len(found) == 6
    for name, system in found.items():
        assert scipy.sparse.issparse(system.stiffness) == (name in ("d.npz", "e.npz", "f.mtx")), name
        dense = system.stiffness.toarray() if scipy.sparse.issparse(system.stiffness) else system.stiffness
        assert np.array_equal(dense, k), name


@pytest.mark.parametrize(("symmetry", "sign"), [("general", 0.0), ("symmetric", 1.0), ("skew-symmetric", -1.0)])
def test_what_a_matrix_market_file_says_of_symmetry_is_done(symmetry, sign, tmp_path, arrays):
    k = arrays["stiffness"] + sign * arrays["stiffness"].T
    scipy.io.mmwrite(tmp_path / "a.mtx", k, symmetry=symmetry)
    scipy.io.mmwrite(tmp_path / "b.mtx", scipy.sparse.coo_array(k), symmetry=symmetry)
    (tmp_path / "mine.toml").write_text(SCENE.replace("K.npz", "[ab].mtx").replace('"file"\nw', "0.0\nw"))
    found = {
        member.source.origin.name: member.system().stiffness for member in expand(load_scene(tmp_path / "mine.toml"))
    }
    assert len(found) == 2
    assert np.array_equal(found["a.mtx"], k)
    assert np.array_equal(found["b.mtx"].toarray(), k)


def test_entries_of_a_sparse_file_may_be_in_any_order_and_add_up(tmp_path, rng):
    rows, values = np.concatenate([rng.permutation(4), rng.permutation(4)]), rng.uniform(1.0, 2.0, 8)
    rows[1] = rows[0]
    indices, indptr = rows.astype(np.int32), np.array([0, 4, 4, 8, 8], np.int32)
    np.savez(tmp_path / "K.npz", data=values, indices=indices, indptr=indptr, shape=(4, 4), format=b"csc")
    scene = SCENE.replace('"file"\nw', "0.0\nw")
    (tmp_path / "mine.toml").write_text(scene)
    expected = np.zeros((4, 4))
    np.add.at(expected, (rows, [0, 0, 0, 0, 2, 2, 2, 2]), values)
    for member in expand(load_scene(tmp_path / "mine.toml")):
        np.testing.assert_allclose(member.system().stiffness.toarray(), expected, rtol=1e-15)


@pytest.mark.parametrize("key", ["indices", "indptr"])
@pytest.mark.parametrize("kind", [bool, np.float64])
def test_places_of_a_sparse_file_are_integers(key, kind, tmp_path):
    places = {"indices": np.array([0, 1]), "indptr": np.array([0, 1, 1])}
    places[key] = places[key].astype(kind)  # the same numbers
    np.savez(tmp_path / "K.npz", data=[1.0, 2.0], shape=(2, 2), format=b"csc", **places)
    (tmp_path / "mine.toml").write_text(SCENE.replace('"file"\nw', "0.0\nw"))
    with pytest.raises(SceneError, match=f"{key}: expected integers, got an array of type "):
        load_scene(tmp_path / "mine.toml")


def test_a_dataset_of_files_is_the_same_on_workers_grows_and_outlives_them(tmp_path, arrays, content):
    text = SCENE.replace("K.npz", "K*.npz")
    file = written(tmp_path, arrays, text)
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    run_ensemble(load_scene(file), tmp_path / "there", workers=1)
    assert content(tmp_path / "there") == content(tmp_path / "out")
    before = content(tmp_path / "out" / "data")
    np.savez(tmp_path / "K-new.npz", **arrays | {"stiffness": arrays["stiffness"] + np.eye(4)})
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert before.items() <= content(tmp_path / "out" / "data").items()
    for one in tmp_path.glob("K*.npz"):
        one.unlink()
    assert verify(tmp_path / "out") == []
    assert sorted(query.members(tmp_path / "out").file.unique()) == ["K-new.npz", "K.npz"]


def test_a_file_that_changed_is_said_and_nothing_is_done(tmp_path, arrays, content, capsys):
    file = written(tmp_path, arrays)
    scene = load_scene(file)
    run_ensemble(scene, tmp_path / "out", workers=0)
    before = content(tmp_path / "out")
    written(tmp_path, arrays | {"friction": arrays["friction"] * 1.5})
    with pytest.raises(
        StoreError, match=r"system\.files\.K\.npz: sha256 [0-9a-f]{12}, version 2 here, sha256 .* there"
    ):
        run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert content(tmp_path / "out") == before
    systems._read.cache_clear()
    with pytest.raises(SceneError, match=r"K\.npz as it was when the scene was read .* got another"):
        run_ensemble(scene, tmp_path / "new", workers=0)  # changed between the reading and the run


def test_the_digest_is_of_all_bytes_of_a_file(tmp_path, rng):
    stiffness = np.diag(rng.uniform(1.0, 2.0, 40))
    text = SCENE.replace("K.npz", "K.npy").replace("n = 4", "n = 40").replace('"file"\nw', "0.0\nw")
    (tmp_path / "mine.toml").write_text(text)
    np.save(tmp_path / "K.npy", stiffness)
    content = bytearray((tmp_path / "K.npy").read_bytes())
    assert len(content) > 3 * 4096
    scene = load_scene(tmp_path / "mine.toml")
    assert scene.system.files["K.npy"].sha256 == hashlib.sha256(content).hexdigest()
    run_ensemble(scene, tmp_path / "out", workers=0)
    for at in (-1, int(rng.integers(4096, len(content))), 4096):
        changed = content.copy()
        changed[at] ^= 1
        (tmp_path / "K.npy").write_bytes(changed)
        systems._read.cache_clear()
        with pytest.raises(SceneError, match=r"K\.npy as it was when the scene was read .* got another"):
            systems.read(expand(scene)[0].source.origin)
        with pytest.raises(StoreError, match=r"system\.files\.K\.npy: sha256"):
            run_ensemble(load_scene(tmp_path / "mine.toml"), tmp_path / "out", workers=0)


@pytest.mark.parametrize(("how", "got"), [("ab", "others"), ("wb", "none")])
def test_a_file_that_is_written_while_it_is_read_is_refused(how, got, tmp_path, arrays, monkeypatch):
    file, own = written(tmp_path, arrays), os.fstat

    def writes_on(descriptor):
        facts = own(descriptor)
        with open(tmp_path / "K.npz", how) as stream:
            stream.write(b"more" if how == "ab" else b"")
        return facts

    monkeypatch.setattr(os, "fstat", writes_on)
    with pytest.raises(SceneError, match=rf"expected \d+ bytes in .*K\.npz, got {got}; write the file before it is"):
        load_scene(file)


def test_what_a_file_claims_is_held_against_memory_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(distributed.system, "MEMORY_LIMIT", 10**8)
    n = 2500
    np.savez_compressed(tmp_path / "K.npz", stiffness=np.zeros((n, n)))
    (tmp_path / "mine.toml").write_text(SCENE.replace("n = 4", f"n = {n}"))
    tracemalloc.start()
    with pytest.raises(SceneError, match=r"expected what this machine can hold, 0\.1 GB, got .* takes 0\.15 GB"):
        load_scene(tmp_path / "mine.toml")
    assert tracemalloc.get_traced_memory()[1] < 8 * n**2 / 4
    tracemalloc.stop()


def test_zeros_that_were_packed_are_not_unpacked(tmp_path, monkeypatch):
    """A file of a thousandth of their bytes."""
    monkeypatch.setattr("stickslip.pipeline.scene.readers.npz._SMALL", 10**6)
    np.savez_compressed(tmp_path / "K.npz", stiffness=np.zeros((2000, 2000)))
    (tmp_path / "mine.toml").write_text(SCENE.replace("n = 4", "n = 2000"))
    tracemalloc.start()
    with pytest.raises(SceneError, match=r"expected at most 3 MB in \d+ bytes, got 32 MB; save a sparse K"):
        load_scene(tmp_path / "mine.toml")
    assert tracemalloc.get_traced_memory()[1] < 8 * 10**6
    tracemalloc.stop()


def test_holes_are_not_read(tmp_path):
    np.save(tmp_path / "K.npy", np.eye(2))
    os.truncate(tmp_path / "K.npy", 6 * 2**30)
    (tmp_path / "mine.toml").write_text(SCENE.replace("K.npz", "K.npy"))
    tracemalloc.start()
    with pytest.raises(SceneError, match=r"K\.npy: expected content, got holes"):
        load_scene(tmp_path / "mine.toml")
    assert tracemalloc.get_traced_memory()[1] < 10**7
    tracemalloc.stop()


def test_damping_is_a_number_or_one_for_each_block_or_two_blocks(tmp_path):
    np.savez_compressed(tmp_path / "K.npz", stiffness=np.eye(4), damping=np.zeros(10**7, np.int8))
    (tmp_path / "mine.toml").write_text(SCENE)
    with pytest.raises(SceneError, match=r"damping: expected .* shape \(4,\), got shape \(10000000,\)"):
        load_scene(tmp_path / "mine.toml")


def test_a_packed_text_and_a_name_that_no_scene_can_hold_are_refused(tmp_path, arrays):
    stream = io.BytesIO()
    scipy.io.mmwrite(stream, arrays["stiffness"])
    (tmp_path / "K.mtx.gz").write_bytes(gzip.compress(stream.getvalue()))
    (tmp_path / "mine.toml").write_text(SCENE.replace("K.npz", "K.mtx.gz"))
    with pytest.raises(SceneError, match=r"K\.mtx\.gz: expected .* got a file compressed by gzip"):
        load_scene(tmp_path / "mine.toml")
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/K\xff.npz")).write_bytes(b"PK")
    (tmp_path / "mine.toml").write_text(SCENE.replace("K.npz", "K?.npz"))
    with pytest.raises(SceneError, match=r"printable names, got 'K\\udcff\.npz'"):
        load_scene(tmp_path / "mine.toml")


def test_a_file_is_found_from_another_directory_than_the_scene_was_read_in(tmp_path, arrays, monkeypatch):
    monkeypatch.chdir(written(tmp_path, arrays).parent)
    member = expand(load_scene(Path("mine.toml")))[0]
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")  # as a worker that was started there
    systems._read.cache_clear()
    assert member.system().n == 4


BAD = {
    "not square": ({"stiffness": np.zeros((4, 3))}, ["K.npz: stiffness", "square", "(4, 3)"]),
    "nan": ({"stiffness": np.full((4, 4), np.nan)}, ["K.npz: stiffness", "finite", "NaN"]),
    "text": ({"stiffness": np.full((4, 4), "a")}, ["K.npz", "stiffness: expected an array of real numbers", "<U1"]),
    "wholes beyond floats": ({"stiffness": np.diag([1, 2, 3, 2**53 + 1])}, ["K.npz", "stiffness: ", "up to 2^53"]),
    "objects": ({"stiffness": np.full((4, 4), None)}, ["K.npz", "pickle"]),
    "friction of others": ({"friction": np.ones(3)}, ["K.npz: friction", "shape (4,)"]),
    "negative friction": ({"friction": -np.ones(4)}, ["K.npz: friction", "mu >= 0"]),
    "nan in a start": ({"z0": np.full(4, np.nan)}, ["K.npz: z0", "finite"]),
    "an unknown array": ({"frictoin": np.ones(4)}, ["K.npz", "`stiffness`", "frictoin"]),
}


@pytest.mark.parametrize("case", BAD)
def test_a_file_that_is_none_is_refused_in_a_line(case, tmp_path, arrays, capsys, monkeypatch):
    changed, words = BAD[case]
    monkeypatch.chdir(tmp_path)
    written(tmp_path, arrays | changed)
    assert main(["run", "mine.toml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(word in line for word in words), line
    assert sorted(one.name for one in tmp_path.iterdir()) == ["K.npz", "mine.toml"]


BAD_SCENES = {
    "no such file": ("K.npz", "none.npz", ["system.path", "'none.npz'", "names none in"]),
    "a folder": ('"K.npz"', '"."', ["system.path: expected a file, got the directory '.'"]),
    "another kind of file": ('"K.npz"', '"mine.toml"',
        ["system.path", "mine.toml: expected an .npz", "something else"]),
    "no path": ('path = "K.npz"\n', "", ["system.path", 'add `path = "K.npz"`']),
    "a path of an ensemble": ('"file"\npath', '"full"\npath', ["system.path", 'coupling = "full"']),
    "a key that the file has": ("n = 4", "n = 4\nfriction = 1.0", ["system.friction", "array `friction` of K.npz"]),
    "a start that the file lacks": ("w = {uniform = [-0.3, 0.1]}\ndraws = 2", 'w = "file"', ["start.w", "`w0`"]),
    "a scale of a file": ("n = 4", "n = 4\nkappa = 0.2", ["system.kappa", "K itself", "remove it"]),
}  # fmt: skip


@pytest.mark.parametrize(("more", "is_said"), [({}, True), ({"mass": np.full(4, 2.0)}, False)])
def test_masses_that_nothing_gives_are_told(more, is_said, tmp_path, arrays, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, arrays | more)
    assert main(["run", "mine.toml", "--dry-run"]) == 0
    assert ("masses  1, as neither the files nor [system] give any" in capsys.readouterr().out) == is_said


def test_where_files_have_several_sizes_the_advice_works(tmp_path, arrays):
    """Not that of one file after the other."""
    np.savez(tmp_path / "K-small.npz", stiffness=np.eye(3))
    scene = SCENE.replace("K.npz", "K*.npz").replace('z = "file"', "z = 0.1")
    with pytest.raises(SceneError, match=r"system\.n: expected .* of the files, \[3, 4\], got \[4\]; leave n out"):
        load_scene(written(tmp_path, arrays, scene))
    assert load_scene(written(tmp_path, arrays, scene.replace("n = 4\n", ""))).system.n == (3, 4)


def test_copies_of_a_file_are_refused(tmp_path, arrays):
    np.savez(tmp_path / "K-copy.npz", **arrays)
    with pytest.raises(SceneError, match=r"system\.path: expected files that differ, got K-copy\.npz and K\.npz"):
        load_scene(written(tmp_path, arrays, SCENE.replace("K.npz", "K*.npz")))


def known(rng, n_files):
    """A scene that is read with what is known of its files, which need not be there."""
    table = '[system.files."K{:05d}.npz"]\nsha256 = "{}"\nn = 4\nscale = 1.0\nentries = 16\nis_sparse = false\n'
    files = [table.format(k, rng.bytes(32).hex()) + "arrays = []\nversion = 2\n" for k in range(n_files)]
    text = SCENE.replace("K.npz", "K*.npz").replace('"file"\nw', "0.0\nw").replace("draws = 2\n", "")
    return text.replace("matrices = 2", "matrices = 1") + "".join(files)


def test_files_are_not_compared_two_by_two(rng, monkeypatch):
    n_asked = 0

    get = FileTable.__getattribute__

    def counting(table, key):
        nonlocal n_asked
        n_asked += key == "sha256"
        return get(table, key)

    monkeypatch.setattr(FileTable, "__getattribute__", counting)
    n_files = 300
    scene = parse_scene(known(rng, n_files).replace("t_end = 5.0", "t_end = 1e5").encode())
    assert len(tasks(scene)) > n_files / 2
    assert n_files <= n_asked < 10 * n_files
    matrices = [member.source.matrix for member in expand(scene)]
    assert len(set(matrices)) == n_files
    assert max(matrices) > 2**62  # all of 300 are below it once in 10^90 times
    assert max(matrices) < 2**63


def test_a_dataset_of_before_is_read_with_its_own_numbers(tmp_path, arrays):
    file = written(tmp_path, arrays)
    new = load_scene(file)
    text = new.source
    assert text.count(", version = 2") == 1
    (tmp_path / "old.toml").write_text(text.replace(", version = 2", ""))  # as it was written then
    old = load_scene(tmp_path / "old.toml")
    sha256 = hashlib.sha256((tmp_path / "K.npz").read_bytes()).hexdigest()
    for scene, kind in ((old, np.int32), (new, np.int64)):
        out = tmp_path / kind.__name__
        run_ensemble(scene, out, workers=0)
        assert verify(out) == []
        found = query.members(out).matrix
        assert found.dtype == kind
        digests = [hashlib.sha256(f"{sha256} {draw}".encode()).hexdigest() for draw in (0, 1)]
        expected = {int(one[:7], 16) if scene is old else int(one[:16], 16) // 2 for one in digests}
        assert set(found) == expected
    with pytest.raises(StoreError, match=r"K\.npz: sha256 \w{12}, version 2 here, sha256 \w{12} there"):
        run_ensemble(new, tmp_path / "int32", workers=0)
    more = text.replace(", version = 2", "").replace("matrices = 2", "matrices = 3")
    (tmp_path / "old.toml").write_text(more)
    run_ensemble(load_scene(tmp_path / "old.toml"), tmp_path / "int32", workers=0)  # it grows as it began
    assert query.members(tmp_path / "int32").matrix.nunique() == 3


@pytest.mark.parametrize("case", BAD_SCENES)
def test_a_scene_that_does_not_fit_its_file_is_refused(case, tmp_path, arrays):
    old, new, words = BAD_SCENES[case]
    assert SCENE.count(old) == 1
    with pytest.raises(SceneError) as caught:
        load_scene(written(tmp_path, arrays, SCENE.replace(old, new)))
    (line,) = str(caught.value).splitlines()
    assert all(word in line for word in words), line


def test_rayleighs_damping_is_in_proportion_to_masses_and_stiffnesses():
    def scene(rayleigh):
        system = f'[system]\ncoupling = "chain"\nn = 4\nmass = {{uniform = [0.8, 1.2]}}\nrayleigh = {rayleigh}\n'
        return parse_scene(f"{system}[start]\nz = 0.0\nw = 0.0\n[run]\nt_end = 2.0\nmatrices = 1\n{ENDING}".encode())

    diagonal, full = (member.system() for member in expand(scene("{mass = 0.1, stiffness = [0.0, 0.2]}")))
    np.testing.assert_array_equal(diagonal.damping, 0.1 * diagonal.mass)
    assert diagonal.cross_damping is None
    expected = 0.1 * np.diag(full.mass) + 0.2 * full.stiffness.toarray()
    np.testing.assert_allclose(full.damping_matrix.toarray(), expected, rtol=1e-15)
    assert scene("[0.1, 0.2]").system.rayleigh.model_dump() == {"mass": 0.1, "stiffness": 0.2}
