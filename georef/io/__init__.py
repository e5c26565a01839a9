"""Readers and writers, one format a file: read_*(path) -> type, write_*(value, path)."""
