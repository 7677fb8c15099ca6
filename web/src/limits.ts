// The bound of one view, the twin of sundae_ns/rasterize/types.py, which says how it was chosen: a small file can
// describe a view that takes minutes and all of the memory.

/** Most pairs of a tile and a primitive in a view that is drawn: 8,192 in each tile on average, 4 for each primitive. */
export const mostPairs = (tiles: number, count: number): number => 8192 * tiles + 4 * count + 2 ** 22;
