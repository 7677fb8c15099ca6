// The bound of one view, the twin of sundae_ns/rasterization/limits.py, which says how it was chosen: a small file can
// describe a view that takes minutes and all of the memory.

/** Most primitives in a tile, on average over the image. */
const MOST_PER_TILE = 8192;
/** Pairs for each primitive, and of any view, beside these. */
const PER_PRIMITIVE = 4;
const ALWAYS = 2 ** 22;

/** Most pairs of a tile and a primitive in a view that is drawn. */
export const mostPairs = (tiles: number, count: number): number =>
  MOST_PER_TILE * tiles + PER_PRIMITIVE * count + ALWAYS;
