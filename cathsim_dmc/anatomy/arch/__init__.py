"""Parametric aortic arches: parameters, vessel tree, sampling."""
