import {
  Application,
  Asset,
  Color,
  Entity,
  FILLMODE_NONE,
  Mat4,
  Quat,
  RESOLUTION_FIXED,
  SHADERLANGUAGE_GLSL,
  ShaderChunks,
} from "playcanvas";
import { afterFrames, columns, FAR, FROM_GLTF, freshCanvas, NEAR, pixelsOn, projectionOf, type Show } from "./shots";

/** By PlayCanvas; `options.scene` are its settings of splats, `blur` what it adds to variances in half pixels. */
export const showByPlayCanvas: Show = async (file, cameras, options) => {
  const { width, height } = cameras[0]!;
  const canvas = freshCanvas(cameras[0]!);
  const kept = { antialias: false, preserveDrawingBuffer: true };
  const app = new Application(canvas, { graphicsDeviceOptions: kept });
  app.setCanvasFillMode(FILLMODE_NONE, width, height);
  app.setCanvasResolution(RESOLUTION_FIXED, width, height);
  // Frames are drawn below: Chromium asks for none while a page without a window is at work.
  app.requestAnimationFrame = () => undefined;
  app.start();
  const isGltf = file.endsWith(".glb");
  const asset = new Asset(file, isGltf ? "container" : "gsplat", { url: file });
  await new Promise<void>((done, fail) => {
    asset.on("load", () => done());
    asset.on("error", (error: string) => fail(new Error(error)));
    app.assets.add(asset);
    app.assets.load(asset);
  });
  Object.assign(app.scene.gsplat, options.scene);
  const chunks = ShaderChunks.get(app.graphicsDevice, SHADERLANGUAGE_GLSL);
  const [name, { blur = 0.3 }] = ["gsplatCornerVS", options.renderer as { blur?: number }];
  chunks.set(name, chunks.get(name).replaceAll("+ 0.3", `+ ${blur}`));
  const turn = (rows: readonly number[]) => new Quat().setFromMat4(new Mat4().set(columns(rows)));
  const scene = isGltf ? asset.resource.instantiateRenderEntity() : new Entity();
  if (isGltf) scene.setRotation(turn(FROM_GLTF));
  else scene.addComponent("gsplat", { asset, unified: true });
  app.root.addChild(scene);
  const camera = new Entity();
  let place = cameras[0]!;
  camera.addComponent("camera", {
    clearColor: new Color(0, 0, 0),
    nearClip: NEAR,
    farClip: FAR,
    frustumCulling: false,
  });
  camera.camera.calculateProjection = (matrix: { set(values: number[]): void }) =>
    matrix.set(columns(projectionOf(place)));
  app.root.addChild(camera);
  if (file.endsWith("lod-meta.json")) {
    Object.assign(scene.gsplat, { lodRangeMin: 0, lodRangeMax: 0 }); // the finest level alone
    let loaded = false;
    app.systems.gsplat.on("frame:ready", (_camera: unknown, _layer: unknown, ready: boolean, loading: number) => {
      loaded ||= ready && loading === 0;
    });
    while (!loaded) await afterFrames(() => app.tick(performance.now()));
  }
  const images: string[] = [];
  for (place of cameras) {
    const { pose } = place;
    camera.setPosition(pose[3]!, pose[7]!, pose[11]!);
    camera.setRotation(turn([...pose, 0, 0, 0, 1]));
    await afterFrames(() => app.tick(performance.now()));
    images.push(pixelsOn(canvas));
  }
  app.destroy();
  return images;
};
