// Times each kernel of a frame of the page's renderer, which encodes many in one pass: while the watch runs, each
// dispatch becomes a pass of its own with two timestamps.

/** Kernels in one frame: 24 of each splat, and at most 30 of the head. */
const MOST = 128;
const NANOSECONDS = 1e6;

/** What kernels do, where it is not their own name. */
const PARTS: Record<string, string> = {
  measure: "list_tiles",
  place: "list_tiles",
  emit: "list_tiles",
  find_ranges: "list_tiles",
  fold: "head_fold",
  unfold: "head_fold",
  convolve: "head_convolve",
  pool: "head_resize",
  upsample: "head_resize",
};
const SORTS = ["count", "scan", "scatter"];

/** Names the kernels of one pass of the renderer; passes of the head and of the splatter share labels. */
function partsOf(labels: string[]): string[] {
  const measured = labels.indexOf("measure");
  const head = labels.includes("fold");
  return labels.map((label, i) => {
    if (SORTS.includes(label)) return i < measured ? "sort_depths" : "sort_tiles";
    if (head && label === "project") return "head_project";
    return PARTS[label] ?? label;
  });
}

export const quantileOf = (values: number[], share: number): number => {
  const sorted = [...values].sort((a, b) => a - b);
  const place = share * (sorted.length - 1);
  const [low, high] = [sorted[Math.floor(place)]!, sorted[Math.ceil(place)]!];
  return Number((low + (high - low) * (place % 1)).toFixed(4));
};
export const medianOf = (values: number[]): number => quantileOf(values, 0.5);

export class Stopwatch {
  private readonly encoderOf: () => GPUCommandEncoder;
  private readonly queries: GPUQuerySet;
  private readonly resolved: GPUBuffer;
  private readonly names: string[] = [];
  private splats = 0;
  private running = false;

  constructor(private readonly device: GPUDevice) {
    this.queries = device.createQuerySet({ type: "timestamp", count: 2 * MOST });
    this.resolved = device.createBuffer({
      size: 16 * MOST,
      usage: GPUBufferUsage.QUERY_RESOLVE | GPUBufferUsage.COPY_SRC,
    });
    this.encoderOf = device.createCommandEncoder.bind(device);
    device.createCommandEncoder = () => (this.running ? this.watched(this.encoderOf()) : this.encoderOf());
  }

  start(): void {
    this.running = true;
    this.names.length = this.splats = 0;
  }

  /** Milliseconds of each part of the frame since the start. */
  async stop(): Promise<Map<string, number>> {
    this.running = false;
    const { device, names } = this;
    const usage = GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ;
    const copy = device.createBuffer({ size: 16 * MOST, usage });
    const encoder = this.encoderOf();
    encoder.resolveQuerySet(this.queries, 0, 2 * names.length, this.resolved, 0);
    encoder.copyBufferToBuffer(this.resolved, 0, copy, 0, 16 * names.length);
    device.queue.submit([encoder.finish()]);
    await copy.mapAsync(GPUMapMode.READ);
    const stamps = new BigUint64Array(copy.getMappedRange());
    const parts = new Map<string, number>();
    names.forEach((name, i) => {
      const spent = Number(stamps[2 * i + 1]! - stamps[2 * i]!) / NANOSECONDS;
      parts.set(name, (parts.get(name) ?? 0) + spent);
    });
    copy.destroy();
    return parts;
  }

  private next(name: string): GPUComputePassTimestampWrites {
    const first = 2 * this.names.length;
    if (this.names.push(name) > MOST) throw new Error("a frame has more kernels than the stopwatch has timestamps");
    return { querySet: this.queries, beginningOfPassWriteIndex: first, endOfPassWriteIndex: first + 1 };
  }

  private watched(encoder: GPUCommandEncoder): GPUCommandEncoder {
    const passOf = encoder.beginComputePass.bind(encoder);
    const drawOf = encoder.beginRenderPass.bind(encoder);
    encoder.beginRenderPass = (about) => drawOf({ ...about, timestampWrites: this.next("present") });
    encoder.beginComputePass = () => {
      const first = this.names.length;
      let pipeline: GPUComputePipeline;
      let groups: GPUBindGroup[] = [];
      const alone = (dispatch: (pass: GPUComputePassEncoder) => void): void => {
        const pass = passOf({ timestampWrites: this.next(pipeline.label) });
        pass.setPipeline(pipeline);
        groups.forEach((group, index) => {
          pass.setBindGroup(index, group);
        });
        dispatch(pass);
        pass.end();
      };
      const stand: Partial<Record<keyof GPUComputePassEncoder, unknown>> = {
        setPipeline: (next: GPUComputePipeline) => {
          [pipeline, groups] = [next, []];
        },
        setBindGroup: (index: number, group: GPUBindGroup) => {
          groups[index] = group;
        },
        dispatchWorkgroups: (x: number, y: number, z: number) => alone((pass) => pass.dispatchWorkgroups(x, y, z)),
        dispatchWorkgroupsIndirect: (sizes: GPUBuffer, offset: number) =>
          alone((pass) => pass.dispatchWorkgroupsIndirect(sizes, offset)),
        end: () => this.rename(first),
      };
      return stand as unknown as GPUComputePassEncoder;
    };
    return encoder;
  }

  /** Gives the kernels of a pass that has ended the names of their parts. */
  private rename(first: number): void {
    const parts = partsOf(this.names.slice(first));
    // A second splat is what the head sees at the scale of its training.
    const again = parts.includes("blend") && this.splats++ > 0 ? "seen_" : "";
    parts.forEach((part, i) => {
      this.names[first + i] = again + part;
    });
  }
}
