// Other viewers as functions of a page: each shows a file of base colours from some cameras and returns the pixels, for
// the comparison with Python's images (benchmarks/bench_viewers.py).

import { SceneRevealMode, Viewer } from "@mkkellogg/gaussian-splats-3d";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { LinearSRGBColorSpace, Matrix4, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";
import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { WebGPURenderer } from "three/webgpu";
import type { Camera } from "../src/scene/scene";
import { showByBabylon } from "./babylon";
import { showByPlayCanvas } from "./playcanvas";
import { afterFrames, columns, FROM_GLTF, type Options, pixelsOn, projectionOf, type Show, text } from "./shots";

class CaptureCamera extends PerspectiveCamera {
  /** Takes the place and the lens of a camera of the capture. */
  take(place: Camera): void {
    const matrix = new Matrix4().fromArray(columns([...place.pose, 0, 0, 0, 1]));
    matrix.decompose(this.position, this.quaternion, new Vector3());
    this.updateMatrixWorld(true);
    this.projectionMatrix.fromArray(columns(projectionOf(place)));
    this.projectionMatrixInverse.copy(this.projectionMatrix).invert();
  }

  /** Viewers call this when they are resized; it would forget the lens. */
  override updateProjectionMatrix(): void {}
}

function pixelsOf(renderer: WebGLRenderer): string {
  const gl = renderer.getContext();
  const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return text(pixels);
}

/** Prepares a viewer for a file; returns what draws a frame. */
type Opener = (file: string, renderer: WebGLRenderer, camera: CaptureCamera, options: Options) => Promise<() => void>;

const spark: Opener = async (file, renderer, camera, options) => {
  const scene = new Scene();
  scene.add(new SparkRenderer({ renderer, ...options.renderer }));
  const mesh = new SplatMesh({ url: file, ...options.scene });
  await mesh.initialized;
  scene.add(mesh);
  return () => renderer.render(scene, camera);
};

const gaussianSplats3D: Opener = async (file, renderer, camera, options) => {
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
};

/** By three.js's own loader of .glb; its renderer draws by WebGL here, too. */
const showByThree: Show = async (file, cameras) => {
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
  found.applyMatrix4(new Matrix4().fromArray(columns(FROM_GLTF)));
  const scene = new Scene();
  scene.add(found);
  const camera = new CaptureCamera();
  const images: string[] = [];
  for (const place of cameras) {
    camera.take(place);
    await afterFrames(() => renderer.render(scene, camera));
    images.push(pixelsOn(renderer.domElement));
  }
  renderer.dispose();
  return images;
};

/** By a viewer that draws with a renderer of three.js. */
const showByOpener: (open: Opener) => Show = (open) => async (file, cameras, options) => {
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
  const draw = await open(file, renderer, camera, options);
  const images: string[] = [];
  for (const place of cameras) {
    camera.take(place);
    await afterFrames(draw);
    images.push(pixelsOf(renderer));
  }
  renderer.dispose();
  return images;
};

const SHOWS: Record<string, Show> = {
  spark: showByOpener(spark),
  gaussianSplats3D: showByOpener(gaussianSplats3D),
  three: showByThree,
  playcanvas: showByPlayCanvas,
  babylon: showByBabylon,
};

/** Images of a file by one viewer. */
const show = (name: string, ...rest: Parameters<Show>): Promise<string[]> => SHOWS[name]!(...rest);

Object.assign(window, { show });
