"""The kinds of surface, by number, as the texture kernel knows them; colours are linear albedos."""

from __future__ import annotations

PLASTER, BRICK, STONE, WOOD, GLASS, TILES, ASPHALT, PAVING = range(8)
KERB, PAINT, SIGN, LACQUER, RUBBER, LEAF, BARK, METAL = range(8, 16)
GRASS, CONCRETE, MANHOLE, MESH, SHOP, PLATE = range(16, 22)

WHITE, GREY, DARK = (0.75, 0.74, 0.71), (0.35, 0.35, 0.34), (0.06, 0.06, 0.065)
