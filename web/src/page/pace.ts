// How large the images are while the camera moves, from the time that they take.

/** Milliseconds of a frame: thirty in a second, less what the browser adds. */
const AIM = 30;
/** Each step takes the square root of a half of the pixels. */
const PER_OCTAVE = 4;
/** Steps down to a quarter of each side. */
const STEPS = 8;

export class Pace {
  private step = 0;
  private lastStep = -1;

  /** Share of each side of an image. */
  get share(): number {
    return 2 ** (-this.step / PER_OCTAVE);
  }

  /** Learns the time of a frame in milliseconds; the first frame of a size also makes its buffers, so it is ignored. */
  learn(milliseconds: number): void {
    const settled = this.step === this.lastStep;
    this.lastStep = this.step;
    if (!settled) return;
    // Pixels halve in two steps, and so, at best, does the time.
    const steps = 2 * Math.log2(milliseconds / AIM);
    if (steps > 0.25) this.step = Math.min(this.step + Math.ceil(steps), STEPS);
    else if (steps < -1.25) this.step = Math.max(this.step - 1, 0);
  }
}
