declare module "*.wgsl" {
  const code: string;
  export default code;
}

declare module "*.vert" {
  const code: string;
  export default code;
}

declare module "*.frag" {
  const code: string;
  export default code;
}
