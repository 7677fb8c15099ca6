import "@babylonjs/loaders/glTF/2.0";
import "@babylonjs/loaders/SPLAT";
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera";
import { Engine } from "@babylonjs/core/Engines/engine";
import { ImportMeshAsync } from "@babylonjs/core/Loading/sceneLoader";
import { GaussianSplattingMaterial } from "@babylonjs/core/Materials/GaussianSplatting/gaussianSplattingMaterial";
import { Color4 } from "@babylonjs/core/Maths/math.color";
import { Matrix, Vector3 } from "@babylonjs/core/Maths/math.vector";
import { TransformNode } from "@babylonjs/core/Meshes/transformNode";
import { Scene } from "@babylonjs/core/scene";
import * as fflate from "three/addons/libs/fflate.module.js";
import { afterFrames, columns, FROM_GLTF, freshCanvas, pixelsOn, projectionOf, type Show } from "./shots";

/** By Babylon.js; `options.scene` are settings of its material of splats. */
export const showByBabylon: Show = async (file, cameras, options) => {
  Object.assign(GaussianSplattingMaterial, options.scene);
  const canvas = freshCanvas(cameras[0]!);
  const engine = new Engine(canvas, false, { preserveDrawingBuffer: true });
  const scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  scene.clearColor = new Color4(0, 0, 0, 1);
  const camera = new FreeCamera("camera", Vector3.Zero(), scene);
  let view = Matrix.Identity();
  // A matrix here is the transpose of one of OpenGL, and in memory the same.
  Object.assign(camera, { _getViewMatrix: () => view, _isSynchronizedViewMatrix: () => false });
  // Its own decoders: by default it loads others from a web site.
  const pluginOptions = { splat: { fflate, spzLibraryUrl: undefined } };
  const { meshes } = await ImportMeshAsync(file, scene, { pluginOptions });
  const [root] = meshes;
  if (file.endsWith(".glb")) {
    const turn = new TransformNode("turn", scene);
    Matrix.FromArray(columns(FROM_GLTF)).decomposeToTransformNode(turn);
    root!.parent = turn;
  } else root!.scaling.setAll(1);
  const images: string[] = [];
  for (const place of cameras) {
    view = Matrix.FromArray(columns([...place.pose, 0, 0, 0, 1])).invert();
    camera.freezeProjectionMatrix(Matrix.FromArray(columns(projectionOf(place))));
    await afterFrames(() => scene.render());
    images.push(pixelsOn(canvas));
  }
  engine.dispose();
  return images;
};
