// Packages that are only installed for make browser; the checks take their types as they come.

declare module "webgpu";
declare module "@mkkellogg/gaussian-splats-3d";
declare module "@sparkjsdev/spark";
declare module "playcanvas";
declare module "@babylonjs/loaders/glTF/2.0";
declare module "@babylonjs/loaders/SPLAT";
declare module "@babylonjs/core/Maths/math.color";
declare module "@babylonjs/core/Maths/math.vector";
declare module "@babylonjs/core/Engines/engine";
declare module "@babylonjs/core/scene";
declare module "@babylonjs/core/Cameras/freeCamera";
declare module "@babylonjs/core/Meshes/transformNode";
declare module "@babylonjs/core/Materials/GaussianSplatting/gaussianSplattingMaterial";
declare module "@babylonjs/core/Loading/sceneLoader";
