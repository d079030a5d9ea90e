"""Lightweight vector maps: one schema, importers, surfels, one file of compressed columns."""
