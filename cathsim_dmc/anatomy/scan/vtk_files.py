"""Triangles and lines of VTK's PolyData files, .vtp and .vtk."""

import re
from pathlib import Path
from typing import Any

import numpy as np


def _reported(reader: Any) -> str:
    """Reads the file of a reader; returns the errors and warnings of VTK.

    Of a cut binary array VTK reports a warning alone, and leaves its end undefined.
    """
    from vtkmodules import vtkCommonCore

    window, log = vtkCommonCore.vtkOutputWindow, vtkCommonCore.vtkLogger
    told, before = vtkCommonCore.vtkStringOutputWindow(), window.GetInstance()
    verbosity = log.GetCurrentVerbosityCutoff()
    displayed = vtkCommonCore.vtkObject.GetGlobalWarningDisplay()
    window.SetInstance(told)
    log.SetStderrVerbosity(log.VERBOSITY_OFF)  # it would print them, too
    vtkCommonCore.vtkObject.GlobalWarningDisplayOn()
    try:
        reader.Update()
    finally:
        vtkCommonCore.vtkObject.SetGlobalWarningDisplay(displayed)
        log.SetStderrVerbosity(verbosity)
        window.SetInstance(before)
    return told.GetOutput()


def _poly_data(path: Path) -> Any:
    """The PolyData of a file with checked cells; ValueError if it holds none."""
    from vtkmodules import vtkCommonCore, vtkIOLegacy, vtkIOXML
    from vtkmodules.util.numpy_support import vtk_to_numpy

    vtkCommonCore.vtkObject.GlobalWarningDisplayOff()  # VTK prints errors of reading
    if path.suffix.lower() == ".vtk":
        reader = vtkIOLegacy.vtkPolyDataReader()
        reader.SetFileName(str(path))
        if not reader.IsFilePolyData():
            raise ValueError(
                "it holds no PolyData; extract the surface first (ParaView: Extract "
                "Surface, then save as .vtp)"
            )
    else:
        reader = vtkIOXML.vtkXMLPolyDataReader()
        reader.SetFileName(str(path))
    if re.search(r"(?m)^(ERROR:|Error reading)", _reported(reader)):
        raise ValueError("it is damaged or cut off, or no PolyData")
    read = reader.GetOutput()
    for cells in (read.GetVerts(), read.GetLines(), read.GetPolys(), read.GetStrips()):
        # VTK does not check its indices, and would read beyond the arrays.
        corners = vtk_to_numpy(cells.GetConnectivityArray())
        stops = vtk_to_numpy(cells.GetOffsetsArray())
        beyond = stops[-1:] != len(corners) or np.diff(stops, prepend=0).min() < 0
        if beyond or np.any((corners < 0) | (corners >= read.GetNumberOfPoints())):
            raise ValueError("its cells name points that it does not have")
    if reader.GetErrorCode() or not read.GetNumberOfPoints():
        raise ValueError("it is damaged, or no PolyData")
    return read


def triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3); polygons and strips are divided."""
    from vtkmodules import vtkFiltersCore
    from vtkmodules.util.numpy_support import vtk_to_numpy

    triangulated = vtkFiltersCore.vtkTriangleFilter()
    triangulated.SetInputData(_poly_data(path))
    triangulated.PassLinesOff()
    triangulated.PassVertsOff()
    triangulated.Update()
    found = triangulated.GetOutput()
    corners = vtk_to_numpy(found.GetPolys().GetConnectivityArray())
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64)
    return points, corners.astype(np.int64).reshape(-1, 3)


def space(path: Path) -> str:
    """Frame that a file of 3D Slicer names, such as "SPACE=RAS"; else empty."""
    said = _poly_data(path).GetFieldData().GetAbstractArray("SPACE")
    return f"SPACE={said.GetVariantValue(0).ToString()}" if said else ""


def lines(path: Path) -> list[np.ndarray]:
    """Lines (n_i, 3), such as VMTK's centrelines.

    Pieces into which VMTK has split a centreline at forks are joined again.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    read = _poly_data(path)
    points = vtk_to_numpy(read.GetPoints().GetData()).astype(np.float64)
    corners = vtk_to_numpy(read.GetLines().GetConnectivityArray())
    stops = vtk_to_numpy(read.GetLines().GetOffsetsArray())
    pieces = [points[corners[a:b]] for a, b in zip(stops, stops[1:], strict=False)]
    first = read.GetNumberOfVerts()  # cells are numbered after the vertices

    def of_cells(name: str) -> np.ndarray:
        found = read.GetCellData().GetArray(name)
        rows = np.arange(len(pieces))
        return rows if found is None else vtk_to_numpy(found)[first:][rows]

    ways, tracts = of_cells("CenterlineIds"), of_cells("TractIds")
    return [
        np.concatenate([pieces[k] for k in rows[np.argsort(tracts[rows])]])
        for rows in (np.flatnonzero(ways == way) for way in np.unique(ways))
    ]
