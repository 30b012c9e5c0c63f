"""The files whose import is timed."""

import import_times
import nibabel
import numpy as np
import pytest
import trimesh


def test_both_files_hold_the_lumen_of_the_phantom_in_millimetres(tmp_path):
    mesh = trimesh.load(import_times.surface("simple1", tmp_path))
    image = nibabel.load(import_times.label_map("simple1", tmp_path))
    voxels = np.argwhere(np.asarray(image.dataobj) > 0) @ image.affine[:3, :3].T
    voxels = voxels + image.affine[:3, 3]
    assert len(voxels) == pytest.approx(abs(mesh.volume), rel=0.03)
    assert voxels.mean(axis=0) == pytest.approx(mesh.center_mass, abs=0.3)
