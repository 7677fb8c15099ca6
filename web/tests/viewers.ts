// Other viewers as functions of a page: each shows a file of base colours from some cameras and returns the pixels, for
// the comparison with Python's images (benchmarks/bench_viewers.py).

import { SceneRevealMode, Viewer } from "@mkkellogg/gaussian-splats-3d";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { LinearSRGBColorSpace, Matrix4, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";
import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { WebGPURenderer } from "three/webgpu";
import type { Camera } from "../src/scene/scene";

type Options = { renderer?: object; scene?: object };

const NEAR = 0.01;
const FAR = 1000;
/** Frames before an image is taken: workers sort between them. */
const FRAMES = 12;
const PAUSE = 50;

class CaptureCamera extends PerspectiveCamera {
  /** Takes the place and the lens of a camera of the capture. */
  take({ pose, fx, fy, cx, cy, width, height }: Camera): void {
    const matrix = new Matrix4().fromArray([...pose, 0, 0, 0, 1]).transpose();
    matrix.decompose(this.position, this.quaternion, new Vector3());
    this.updateMatrixWorld(true);
    const [x, y] = [(2 * fx) / width, (2 * fy) / height];
    const [right, up] = [1 - (2 * cx) / width, (2 * cy) / height - 1];
    const depth = [(FAR + NEAR) / (NEAR - FAR), (2 * FAR * NEAR) / (NEAR - FAR)] as const;
    this.projectionMatrix.set(x, 0, right, 0, 0, y, up, 0, 0, 0, ...depth, 0, 0, -1, 0);
    this.projectionMatrixInverse.copy(this.projectionMatrix).invert();
  }

  /** Viewers call this when they are resized; it would forget the lens. */
  override updateProjectionMatrix(): void {}
}

/** The pixels on the canvas, RGBA in bytes, the lowest row first. */
function pixelsOf(renderer: WebGLRenderer): string {
  const gl = renderer.getContext();
  const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return text(pixels);
}

function text(pixels: Uint8Array | Uint8ClampedArray): string {
  let found = "";
  for (let i = 0; i < pixels.length; i += 2 ** 14) found += String.fromCharCode(...pixels.subarray(i, i + 2 ** 14));
  return btoa(found);
}

/** Prepares a viewer for a file; returns what draws a frame. */
type Opener = (file: string, renderer: WebGLRenderer, camera: CaptureCamera, options: Options) => Promise<() => void>;

const OPENERS: Record<string, Opener> = {
  spark: async (file, renderer, camera, options) => {
    const scene = new Scene();
    scene.add(new SparkRenderer({ renderer, ...options.renderer }));
    const mesh = new SplatMesh({ url: file, ...options.scene });
    await mesh.initialized;
    scene.add(mesh);
    return () => renderer.render(scene, camera);
  },
  gaussianSplats3D: async (file, renderer, camera, options) => {
    const viewer = new Viewer({
      renderer,
      camera,
      rootElement: document.body,
      selfDrivenMode: false,
      useBuiltInControls: false,
      sharedMemoryForWorkers: false,
      sceneRevealMode: SceneRevealMode.Instant,
      ...options.renderer,
    });
    await viewer.addSplatScene(file, { showLoadingUI: false, progressiveLoad: false, ...options.scene });
    return () => {
      viewer.update();
      viewer.render();
    };
  },
};

/** Images of a .glb by three.js's own loader, as `show`; its renderer draws by WebGL here, too. */
async function showByThree(file: string, cameras: Camera[]): Promise<string[]> {
  const { width, height } = cameras[0]!;
  const renderer = new WebGPURenderer({ antialias: false, forceWebGL: true });
  await renderer.init();
  renderer.setPixelRatio(1);
  renderer.setSize(width, height);
  renderer.setClearColor(0, 1);
  renderer.outputColorSpace = LinearSRGBColorSpace; // colours of splats are those of the display already
  document.body.replaceChildren(renderer.domElement);
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const { scene: found } = await loader.loadAsync(file);
  // In glTF +y points up; in the model +z does.
  found.applyMatrix4(new Matrix4().set(-1, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1));
  const scene = new Scene();
  scene.add(found);
  const camera = new CaptureCamera();
  const copy = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d")!;
  const images: string[] = [];
  for (const place of cameras) {
    camera.take(place);
    for (let i = 0; i < FRAMES; i++) {
      renderer.render(scene, camera);
      await new Promise((done) => setTimeout(done, PAUSE));
    }
    renderer.render(scene, camera);
    copy.setTransform(1, 0, 0, -1, 0, height); // the lowest row first, as WebGL has it
    copy.drawImage(renderer.domElement, 0, 0);
    images.push(text(copy.getImageData(0, 0, width, height).data));
  }
  renderer.dispose();
  return images;
}

/** Images of a file by one viewer, on a black background; the cameras have one size. */
async function show(name: string, file: string, cameras: Camera[], options: Options): Promise<string[]> {
  if (name === "three") return showByThree(file, cameras);
  const { width, height } = cameras[0]!;
  document.body.replaceChildren();
  Object.assign(document.body.style, { margin: 0, width: `${width}px`, height: `${height}px` });
  const renderer = new WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setPixelRatio(1);
  renderer.setSize(width, height);
  renderer.setClearColor(0, 1);
  document.body.append(renderer.domElement);
  const camera = new CaptureCamera();
  camera.take(cameras[0]!);
  const draw = await OPENERS[name]!(file, renderer, camera, options);
  const images: string[] = [];
  for (const place of cameras) {
    camera.take(place);
    for (let i = 0; i < FRAMES; i++) {
      draw();
      await new Promise((done) => setTimeout(done, PAUSE));
    }
    draw();
    images.push(pixelsOf(renderer));
  }
  renderer.dispose();
  return images;
}

Object.assign(window, { show });
