"""The recording of a training: one file, extended at every checkpoint."""

import dataclasses
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recording_samples import make_episode, make_tube

from cathsim_dmc.recording import viewer
from cathsim_dmc.recording.drawing import Drawing
from cathsim_dmc.recording.rerun_training import TrainingRecording
from cathsim_dmc.recording.scene import BodyGeom
from cathsim_dmc.recording.viewer import ViewerError, live_address

GOAL = {"goal_position": (0.0, 0.0, 0.03), "goal_radius": 0.008}
GEOM = BodyGeom(1, "robot/base", "sphere", [0.01], [0] * 3, [1, 0, 0, 0], [1] * 4)


class Contents:
    """Values by entity and component, static and by frame, in the order of frames."""

    def __init__(self, path):
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        (recording,) = reader.recordings()
        self.identity = recording.recording_id
        self.temporal, self.static, self.layout = {}, {}, {}
        for chunk in reader.stream():
            self._add(chunk)
        (blueprint,) = reader.blueprints()
        for chunk in reader.stream(store=blueprint):
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if ":" in name:
                    found = self.layout.setdefault(name, [])
                    found += batch.column(name).to_pylist()

    def _add(self, chunk):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            key = chunk.entity_path, name
            if name in ("rerun.controls.RowId", "frames"):
                continue
            values = batch.column(name).to_pylist()
            if chunk.is_static:
                self.static.setdefault(key, []).extend(values)
            else:
                frames = batch.column("frames").to_pylist()
                rows = self.temporal.setdefault(key, [])
                rows += zip(frames, values, strict=True)

    def frames(self, entity, name):
        return [frame for frame, _ in self.temporal[entity, name]]

    def scalars(self, entity):
        rows = self.temporal[entity, "Scalars:scalars"]
        return {frame: value[0] for frame, value in rows}


def rows_until(frames):
    return [
        {
            "frames": float(count),
            "seconds": 1.0,
            "success": None if count < 200 else count / 1000,
            "max_force": 0.002 * count,
            "loss": -count,
        }
        for count in range(100, frames + 1, 100)
    ]


def add(recording, episode, frames, rows=()):
    episode = dataclasses.replace(episode, meta={**episode.meta, **GOAL})
    drawing = Drawing.of(episode, make_tube(), robot_geoms=[GEOM])
    recording.add(episode, drawing, frames, rows)


def test_episodes_follow_each_other_on_the_frames_of_the_training(tmp_path):
    path = tmp_path / "training.rrd"
    recording = TrainingRecording(path, window=20)
    first, second = make_episode(6, seed=1), make_episode(4, seed=2)
    add(recording, first, 300, rows_until(400))
    add(recording, second, 500, rows_until(600))
    found = Contents(path)
    states = [*range(300, 307), *range(500, 505)]
    head = found.temporal["/world/catheter/head", "Points3D:positions"]
    assert [frame for frame, _ in head] == states
    np.testing.assert_allclose(
        [place[0] for _, place in head],
        np.concatenate([first.head, second.head]),
        atol=1e-6,
    )
    forces = found.scalars("/series/force/wall_max")
    assert list(forces) == [*range(301, 307), *range(501, 505)]
    np.testing.assert_allclose(
        list(forces.values()),
        1e3 * np.concatenate([first.wall_force_max, second.wall_force_max]),
    )
    # Each row of metrics.csv once, at its own frames, none beyond the checkpoint.
    assert found.scalars("/training/learner/loss") == {
        float(n): -float(n) for n in range(100, 501, 100)
    }
    success = {200.0: 0.2, 300.0: 0.3, 400.0: 0.4, 500.0: 0.5}
    assert found.scalars("/training/success/mean") == success
    assert found.scalars("/training/force/max")[300] == pytest.approx(600)
    recorded = found.scalars("/training/reward/recorded")
    assert recorded == {300: first.reward.sum(), 500: second.reward.sum()}
    texts = found.temporal["/info", "TextDocument:text"]
    assert [text[0].splitlines()[0] for _, text in texts] == [
        "# Checkpoint of 300 frames",
        "# Checkpoint of 500 frames",
    ]
    # The vessel is there once.
    assert len(found.static["/world/vessel", "Mesh3D:vertex_positions"]) == 1


def test_it_opens_with_the_newest_episode_playing(tmp_path):
    recording = TrainingRecording(tmp_path / "training.rrd", window=20)
    add(recording, make_episode(6), 300, rows_until(300))
    add(recording, make_episode(4), 500, rows_until(500))
    layout = Contents(recording.path).layout
    assert layout["TimePanelBlueprint:timeline"] == [["frames"]]
    assert layout["TimePanelBlueprint:time_selection"] == [[{"min": 500, "max": 504}]]
    origins = {origin[0] for origin in layout["ViewBlueprint:space_origin"]}
    curves = ("success", "reward", "force", "length", "speed", "learner/loss")
    assert {f"training/{name}" for name in curves} <= {o.lstrip("/") for o in origins}


def test_what_stands_still_in_one_episode_may_move_in_the_next(tmp_path):
    recording = TrainingRecording(tmp_path / "training.rrd", window=20)
    moving = make_episode(4)
    still = dataclasses.replace(
        moving,
        body_pos=np.repeat(moving.body_pos[:1], 5, axis=0),
        body_quat=np.repeat(moving.body_quat[:1], 5, axis=0),
    )
    add(recording, still, 100)
    add(recording, moving, 200)
    found = Contents(recording.path)
    key = "/world/robot/base", "Transform3D:translation"
    assert key not in found.static
    assert found.frames(*key) == [100, *range(200, 205)]


def test_a_later_process_goes_on_with_the_file(tmp_path):
    path = tmp_path / "training.rrd"
    add(TrainingRecording(path, 20), make_episode(6), 300, rows_until(300))
    before = Contents(path)
    again = TrainingRecording(path, 20)
    assert again.frames == 300
    add(again, make_episode(4), 500, rows_until(500))
    after = Contents(path)
    assert after.identity == before.identity
    for key, values in before.temporal.items():
        assert after.temporal[key][: len(values)] == values, key
    frames = list(after.scalars("/training/learner/loss"))
    assert frames == [100, 200, 300, 400, 500]
    done = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "verified without error" in done.stdout + done.stderr


def test_episodes_longer_than_the_frames_between_do_not_overlap(tmp_path):
    recording = TrainingRecording(tmp_path / "training.rrd", window=20)
    add(recording, make_episode(6), 100)
    add(recording, make_episode(2), 103)
    again = TrainingRecording(recording.path, window=20)
    assert again.frames == 103
    add(again, make_episode(2), 104)
    found = Contents(recording.path)
    head = found.frames("/world/catheter/head", "Points3D:positions")
    assert head == list(range(100, 113))


def test_a_damaged_file_is_put_aside(tmp_path, capsys):
    path = tmp_path / "training.rrd"
    add(TrainingRecording(path, 20), make_episode(6), 300)
    path.write_bytes(b"hello")
    recording = TrainingRecording(path, 20)
    assert recording.frames == -1
    assert "training.rrd.damaged" in capsys.readouterr().out
    add(recording, make_episode(4), 500)
    assert list(Contents(path).scalars("/training/checkpoint").values()) == [500]
    assert (tmp_path / "training.rrd.damaged").read_bytes() == b"hello"


def test_a_viewer_that_takes_nothing_does_not_keep_the_file(tmp_path):
    script = (
        "import os, sys, test_recording_training as t\n"
        "from cathsim_dmc.recording import rerun_training\n"
        "rerun_training.VIEWER_PATIENCE = 0.3\n"
        "recording = t.TrainingRecording(sys.argv[1], 20, sys.argv[2])\n"
        "for frames in (100, 200):\n"
        "    t.add(recording, t.make_episode(6), frames)\n"
        # As the process that records does: a normal end would wait for the viewer.
        "sys.stdout.flush()\n"
        "os._exit(0)\n"
    )
    path = tmp_path / "training.rrd"
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"rerun+http://127.0.0.1:{silent.getsockname()[1]}/proxy"
        assert live_address(address) == address
        done = subprocess.run(
            [sys.executable, "-c", script, str(path), address],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
    assert "the viewer is left alone" in done.stdout
    assert list(Contents(path).scalars("/training/checkpoint")) == [100, 200]


def test_a_viewer_gets_all_of_it(tmp_path):
    from rerun.recording_stream import RecordingStream

    add(TrainingRecording(tmp_path / "training.rrd", 20), make_episode(6), 300)
    copy = tmp_path / "viewer.rrd"

    def connect(stream, address):
        stream.save(copy)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RecordingStream, "connect_grpc", connect)
        recording = TrainingRecording(tmp_path / "training.rrd", 20, "address")
        add(recording, make_episode(4), 500)
        recording._viewer.disconnect()
    file, seen = Contents(recording.path), Contents(copy)
    assert seen.identity == file.identity
    assert seen.temporal == file.temporal


def test_a_viewer_that_cannot_be_is_refused(monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(ViewerError, match="no viewer listens .*leave the viewer out"):
        live_address(f"rerun+http://127.0.0.1:{port}/proxy")
    for wrong in ("localhost", "http://127.0.0.1:80", "rerun+http://a:b/proxy", ""):
        with pytest.raises(ViewerError, match="no address of a viewer; give spawn"):
            live_address(wrong)
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    with pytest.raises(ViewerError, match="no display"):
        live_address("spawn")
