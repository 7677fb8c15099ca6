// What draws the scene on the canvas of the page.

import type { View } from "./view";

/** What is known of a frame. */
export type Times = {
  /** Milliseconds of its passes on the GPU; NaN where the browser does not measure them. */
  splat: number;
  head: number;
  /** Whether the head was left out because the GPU has no buffers of the size that it needs. */
  withoutHead: boolean;
  /** Primitives over each pixel of a view that has too many, of which nothing is drawn; 0 for any other view. */
  crowded: number;
};

export interface Drawer {
  /** Whether it can run the scene's head. */
  readonly hasHead: boolean;

  /** The largest factor, at most 1, by which an image has to shrink to be rendered. */
  limit(width: number, height: number): number;

  /**
   * Renders a view on the canvas, which has its size; the image is whole when the promise ends.
   *
   * @param share - of the head's correction in the image, from 0 to 1
   */
  render(view: View, head: boolean, share: number): Promise<Times>;

  /** Shows the last image again, with another share of the head's correction. */
  fade(share: number): Promise<void>;

  /** Renders a view and returns its pixels, RGBA in bytes. */
  image(view: View, head: boolean): Promise<Uint8ClampedArray<ArrayBuffer>>;
}
