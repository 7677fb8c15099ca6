// The WebGPU device, and small helpers for buffers, pipelines and passes.

/** Buffers may be this large if the adapter allows. */
const WANTED_BUFFER = 2 ** 31 - 4;

export type Gpu = {
  device: GPUDevice;
  /** Whether shaders compute in half precision. */
  half: boolean;
  /** Whether passes are timed. */
  timed: boolean;
};

/** The device, or null where there is no WebGPU. */
export async function openGpu(): Promise<Gpu | null> {
  const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) return null;
  const wanted: GPUFeatureName[] = ["shader-f16", "timestamp-query"];
  const requiredFeatures = wanted.filter((feature) => adapter.features.has(feature));
  const { maxBufferSize, maxStorageBufferBindingSize } = adapter.limits;
  const device = await adapter.requestDevice({
    requiredFeatures,
    requiredLimits: {
      maxBufferSize: Math.min(maxBufferSize, WANTED_BUFFER),
      maxStorageBufferBindingSize: Math.min(maxStorageBufferBindingSize, WANTED_BUFFER),
    },
  });
  return { device, half: device.features.has("shader-f16"), timed: device.features.has("timestamp-query") };
}

/** Bytes that one buffer of the device may have. */
export const largestBuffer = (device: GPUDevice): number =>
  Math.min(device.limits.maxBufferSize, device.limits.maxStorageBufferBindingSize);

export const groupsOf = (channels: number): number => Math.ceil(channels / 4);
export const blocksOf = (count: number, block: number): number => Math.ceil(count / block);

export function storage(device: GPUDevice, bytes: number, usage: GPUBufferUsageFlags = 0): GPUBuffer {
  return device.createBuffer({
    // Bindings are at least 16 bytes long.
    size: Math.max(Math.ceil(bytes / 16) * 16, 16),
    usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST | GPUBufferUsage.COPY_SRC | usage,
  });
}

export function filled(
  device: GPUDevice,
  values: ArrayBufferView<ArrayBuffer>,
  usage: GPUBufferUsageFlags = 0,
): GPUBuffer {
  const buffer = storage(device, values.byteLength, usage);
  device.queue.writeBuffer(buffer, 0, values.buffer, values.byteOffset, values.byteLength);
  return buffer;
}

export function uniform(device: GPUDevice, bytes: number): GPUBuffer {
  return device.createBuffer({ size: bytes, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
}

/** Lines that define the constants of a shader; unsigned numbers are given as text that ends in u. */
export const constants = (values: Record<string, string | number | boolean>): string =>
  Object.entries(values)
    .map(([name, value]) => `const ${name} = ${value};\n`)
    .join("");

export const shader = (device: GPUDevice, ...code: string[]): GPUShaderModule =>
  device.createShaderModule({ code: code.join("") });

export const kernel = (device: GPUDevice, module: GPUShaderModule, entryPoint: string): GPUComputePipeline =>
  device.createComputePipeline({ label: entryPoint, layout: "auto", compute: { module, entryPoint } });

/** A kernel with its buffers, by binding; bindings that the kernel does not use are left out by the caller. */
export class Step {
  private readonly groups: GPUBindGroup[];

  constructor(
    device: GPUDevice,
    private readonly pipeline: GPUComputePipeline,
    ...bindings: Record<number, GPUBuffer | GPUTextureView>[]
  ) {
    this.groups = bindings.map((group, index) =>
      device.createBindGroup({
        layout: pipeline.getBindGroupLayout(index),
        entries: Object.entries(group).map(([binding, resource]) => ({
          binding: Number(binding),
          resource: resource instanceof GPUBuffer ? { buffer: resource } : resource,
        })),
      }),
    );
  }

  private bind(pass: GPUComputePassEncoder): void {
    pass.setPipeline(this.pipeline);
    this.groups.forEach((group, index) => {
      pass.setBindGroup(index, group);
    });
  }

  run(pass: GPUComputePassEncoder, x: number, y = 1, z = 1): void {
    this.bind(pass);
    pass.dispatchWorkgroups(x, y, z);
  }

  /** As many workgroups as a buffer says, at an offset in bytes. */
  runAs(pass: GPUComputePassEncoder, sizes: GPUBuffer, offset: number): void {
    this.bind(pass);
    pass.dispatchWorkgroupsIndirect(sizes, offset);
  }
}
