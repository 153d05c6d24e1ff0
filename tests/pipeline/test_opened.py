"""A dataset that is opened: once for all that is read of it, and of one moment."""

import pickle

import pytest

from stickslip.pipeline import StoreError, load_scene, parse_scene, query, run_ensemble, status
from stickslip.pipeline.dataset import opened as opening
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.scene.scene import Scene
from tests.scenes import COULOMB, ensemble


@pytest.fixture
def counted(monkeypatch):
    """How often a scene is parsed and a manifest read from here on."""
    counts = {"scenes": 0, "manifests": 0}

    def count(name, function):
        def called(*arguments, **more):
            counts[name] += 1
            return function(*arguments, **more)

        return called

    monkeypatch.setattr(opening, "parse_scene", count("scenes", opening.parse_scene))
    monkeypatch.setattr(opening, "read_manifest", count("manifests", opening.read_manifest))
    return counts


def test_what_is_open_is_opened_no_more(finished, counted):
    dataset = open_dataset(finished)
    assert open_dataset(dataset) is dataset
    names = list(query.series(dataset))
    assert query.members(dataset).equals(query.members(finished))
    counted.update(scenes=0, manifests=0)
    assert query.table(dataset, ["member_id"]).num_rows == len(query.members(dataset)) == len(names)
    assert query.n_stick(dataset, names[0])[0][0] == query.events(dataset, names[0]).t_start == 0.0
    assert len(query.all_events(dataset)) == len(names)
    assert not any(map(len, (query.ends(dataset), query.separations(dataset), query.by_threshold(dataset))))
    assert status(dataset).is_complete
    assert counted == {"scenes": 0, "manifests": 0}
    for ask in (query.members, query.series, query.separations, query.all_events, status):
        ask(finished)
        assert counted == {"scenes": 1, "manifests": 1}, ask
        counted.update(scenes=0, manifests=0)


def test_it_goes_to_another_process_as_it_is(finished):
    dataset = open_dataset(finished)
    sent = pickle.loads(pickle.dumps(dataset))
    assert (str(sent.place), sent.manifest, sent.scene.source) == (
        str(dataset.place), dataset.manifest, dataset.scene.source,
    )  # fmt: skip
    assert query.members(sent).equals(query.members(dataset))


def test_a_reader_is_told_what_a_run_has_replaced(scene, tmp_path, fragile):
    """Shards that are added change nothing for it."""
    with fragile(ZeroDivisionError()):
        run_ensemble(scene, tmp_path, workers=0)
    before = open_dataset(tmp_path)
    run_ensemble(scene.changed(run={"matrices": 4}), tmp_path, workers=0)
    before.check()
    assert len(query.members(before)) == scene.n_members < len(query.members(before.again()))
    failed = query.members(before, filters=[("outcome", "=", "failed")])["member_id"].tolist()
    run_ensemble(scene.changed(run={"matrices": 4}), tmp_path, workers=0, retry_failed=True)
    with pytest.raises(
        StoreError, match=r"expected the shard .* when the dataset was opened, got .* since; rerun the"
    ):
        before.check()
    with pytest.raises(StoreError, match="changed since; rerun the command"):
        query.members(before)
    assert set(failed) <= set(query.series(before.again()))


def test_a_scene_that_was_read_is_its_own_source(tmp_path):
    text = ensemble([3], 8.0, 1, COULOMB)
    (tmp_path / "scene.toml").write_text(text)
    for scene in (parse_scene(text.encode()), load_scene(tmp_path / "scene.toml")):
        assert scene.from_source is scene
    made = scene.changed(run={"matrices": 2})
    assert isinstance(made.from_source, Scene)
    assert made.from_source.model_dump_json() == made.model_dump_json()
    assert pickle.loads(pickle.dumps(made)).hash == made.hash
