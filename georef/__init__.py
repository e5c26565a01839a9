"""georef: georeferencing and co-registration of street-level imagery against mapped reference images."""

__version__ = "0.1.0"
