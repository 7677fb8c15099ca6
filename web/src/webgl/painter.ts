// Base colours where there is no WebGPU, or no more: quads sorted by depth on the CPU, blended by WebGL2.

import { coefficientsOf, geometryOf } from "../arrays";
import type { Drawer, Times } from "../drawer";
import { mostPairs } from "../limits";
import { PackError } from "../scene/container";
import type { Scene } from "../scene/scene";
import type { View } from "../view";
import { boundOf, extentsOf, fragmentsOf } from "./overdraw";
import fragmentCode from "./splats.frag";
import vertexCode from "./splats.vert";

const LONGEST = 4096;
/** Seconds after which a view is given up: nothing else can run meanwhile. */
const MOST_SECONDS = 10;
/** Fragments that are drawn at once. */
const FEW_FRAGMENTS = 2 ** 29;
/** Side of the tiles for which limits are stated, pixels. */
const TILE = 16;
/** Texels in a row of a table. */
const ROW = 2048;
/** Buckets of the sort by depth, 2,048 in each octave: in coarser ones large Gaussians are blended in a wrong order. */
const BUCKETS = 2 ** 19;
/** SH degree that the shader evaluates; higher ones change little. */
const MOST_DEGREE = 3;

/** Draws base colours; null where there is no WebGL2. */
export function openPainter(scene: Scene, canvas: HTMLCanvasElement): Painter | null {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
  return gl && new Painter(gl, scene);
}

class Painter implements Drawer {
  readonly hasHead = false;
  private readonly program: WebGLProgram;
  private readonly ids: WebGLBuffer;
  private readonly id: number;
  private readonly order: Uint32Array<ArrayBuffer>;
  private readonly keys: Uint32Array;
  private readonly geometry: Float32Array;
  private readonly extents: Float32Array;
  /** Fragments for which the GPU takes the time that a view may take. */
  private mostInTime = Number.POSITIVE_INFINITY;

  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly scene: Scene,
  ) {
    const { count } = scene.field;
    this.order = new Uint32Array(count);
    this.keys = new Uint32Array(count);
    const degree = Math.min(scene.degree, MOST_DEGREE);
    const lines = `const int DEGREE = ${degree};\nconst bool LOGITS = ${scene.logits};\n`;
    this.program = gl.createProgram();
    const stages: [number, string][] = [
      [gl.VERTEX_SHADER, vertexCode.replace("\n", `\n${lines}`)],
      [gl.FRAGMENT_SHADER, fragmentCode],
    ];
    for (const [kind, code] of stages) {
      const stage = gl.createShader(kind)!;
      gl.shaderSource(stage, code);
      gl.compileShader(stage);
      gl.attachShader(this.program, stage);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) {
      throw new PackError("This browser's WebGL2 cannot draw the scene, so the page shows one image.");
    }
    gl.useProgram(this.program);
    this.geometry = geometryOf(scene);
    this.extents = extentsOf(this.geometry);
    this.table(0, "geometry", this.geometry);
    this.table(1, "coefficients", coefficientsOf({ ...scene, degree, field: lowered(scene, degree) }));
    gl.uniform1i(this.place("antialiased"), Number(scene.antialiased));

    const corners = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, corners);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    const corner = gl.getAttribLocation(this.program, "corner");
    gl.enableVertexAttribArray(corner);
    gl.vertexAttribPointer(corner, 2, gl.FLOAT, false, 0, 0);
    this.ids = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
    this.id = gl.getAttribLocation(this.program, "id");
    gl.enableVertexAttribArray(this.id);
    gl.vertexAttribDivisor(this.id, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...scene.background, 1);
  }

  private place(name: string): WebGLUniformLocation | null {
    return this.gl.getUniformLocation(this.program, name);
  }

  /** A texture of numbers, four in a texel. */
  private table(unit: number, name: string, values: Float32Array): void {
    const { gl } = this;
    const rows = Math.ceil(values.length / 4 / ROW);
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new PackError("The scene is too large for this browser's WebGL2, so the page shows one image.");
    }
    const padded = new Float32Array(rows * ROW * 4);
    padded.set(values);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, ROW, rows, 0, gl.RGBA, gl.FLOAT, padded);
    gl.uniform1i(this.place(name), unit);
  }

  limit(width: number, height: number): number {
    return Math.min(1, LONGEST / Math.max(width, height));
  }

  /** Primitives in front of the camera, the farthest first; returns how many. */
  private sort([, , , , , , , , x, y, z, w]: number[]): number {
    const { means, count } = this.scene.field;
    const { keys, order } = this;
    const ends = new Uint32Array(BUCKETS + 1);
    const bits = new Float32Array(1);
    const word = new Uint32Array(bits.buffer);
    for (let i = 0; i < count; i++) {
      bits[0] = x! * means[3 * i]! + y! * means[3 * i + 1]! + z! * means[3 * i + 2]! + w!;
      // The upper bits of positive floats have the order of the floats; the last bucket is behind the camera.
      const key = bits[0]! > 0 ? BUCKETS - 1 - (word[0]! >>> 12) : BUCKETS;
      keys[i] = key;
      ends[key]! += 1;
    }
    const visible = count - ends[BUCKETS]!;
    let total = 0;
    for (let k = 0; k <= BUCKETS; k++) {
      const size = ends[k]!;
      ends[k] = total;
      total += size;
    }
    for (let i = count - 1; i >= 0; i--) {
      const key = keys[i]!;
      order[ends[key]!] = i;
      ends[key]! += 1;
    }
    return visible;
  }

  /** Draws a view, or only its background; returns the mean number of primitives over a pixel if they are too many. */
  private draw(view: View): number {
    const { gl } = this;
    const m = view.worldToCamera;
    const bound = boundOf(this.geometry, this.extents, view);
    const fragments = bound > FEW_FRAGMENTS ? fragmentsOf(this.geometry, view) : 0;
    const pixels = view.width * view.height;
    const most = TILE ** 2 * mostPairs(pixels / TILE ** 2, this.extents.length);
    const crowded = fragments > Math.min(most, this.mostInTime);
    const visible = crowded ? 0 : this.sort(m);
    gl.bufferData(gl.ARRAY_BUFFER, this.order.subarray(0, visible), gl.STREAM_DRAW);
    gl.viewport(0, 0, view.width, view.height);
    gl.uniformMatrix4fv(this.place("view"), true, [...m, 0, 0, 0, 1]);
    gl.uniform3fv(this.place("origin"), view.center);
    gl.uniform4f(this.place("lens"), view.fx, view.fy, view.cx, view.cy);
    gl.uniform2f(this.place("size"), view.width, view.height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const whole = this.drawQuads(visible, fragments);
    if (!whole) gl.clear(gl.COLOR_BUFFER_BIT);
    return crowded || !whole ? fragments / pixels : 0;
  }

  /** Draws quads with about so many fragments; whether they are all drawn within the time that a view may take. */
  private drawQuads(count: number, fragments: number): boolean {
    const { gl } = this;
    const size = Math.ceil(count / Math.max(Math.ceil(fragments / FEW_FRAGMENTS), 1));
    const started = performance.now();
    for (let first = 0; first < count; first += size) {
      const drawn = Math.min(first + size, count);
      gl.vertexAttribIPointer(this.id, 1, gl.UNSIGNED_INT, 0, 4 * first);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, drawn - first);
      if (size >= count) return true;
      // To read a pixel waits for those that are drawn.
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      const seconds = (performance.now() - started) / 1000;
      if (seconds > MOST_SECONDS && drawn < count) {
        this.mostInTime = (MOST_SECONDS / seconds) * (drawn / count) * fragments;
        return false;
      }
    }
    return true;
  }

  /** A lost context ignores all calls, so it has to be asked. */
  private drawn(view: View): number {
    const crowded = this.draw(view);
    if (this.gl.isContextLost()) throw new Error("the WebGL context is lost");
    return crowded;
  }

  async render(view: View): Promise<Times> {
    const { gl } = this;
    const crowded = this.drawn(view);
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0)!;
    gl.flush();
    // A fence changes only between tasks.
    do await new Promise((resolve) => setTimeout(resolve));
    while (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED);
    gl.deleteSync(fence);
    return { splat: Number.NaN, head: Number.NaN, withoutHead: false, crowded };
  }

  async fade(): Promise<void> {}

  async image(view: View): Promise<Uint8ClampedArray<ArrayBuffer>> {
    const { gl } = this;
    const { canvas } = gl;
    const { width, height } = canvas;
    const size = { width: view.width, height: view.height };
    if (width !== size.width || height !== size.height) Object.assign(canvas, size);
    this.drawn(view);
    const rows = new Uint8Array(4 * view.width * view.height);
    gl.readPixels(0, 0, view.width, view.height, gl.RGBA, gl.UNSIGNED_BYTE, rows);
    if (width !== size.width || height !== size.height) Object.assign(canvas, { width, height });
    // WebGL begins with the lowest row.
    const out = new Uint8ClampedArray(rows.length);
    const row = 4 * view.width;
    for (let y = 0; y < view.height; y++) out.set(rows.subarray(row * y, row * (y + 1)), row * (view.height - 1 - y));
    return out;
  }
}

/** The field with harmonics of a lower degree. */
function lowered({ field, degree }: Scene, wanted: number): Scene["field"] {
  const [width, kept] = [3 * ((degree + 1) ** 2 - 1), 3 * ((wanted + 1) ** 2 - 1)];
  if (width === kept) return field;
  const rest = new Float32Array(field.count * kept);
  for (let i = 0; i < field.count; i++) rest.set(field.features_rest.subarray(width * i, width * i + kept), kept * i);
  return { ...field, features_rest: rest };
}
