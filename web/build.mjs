// Builds the page that sundae export fills with a scene: one file without any address.
//
//     node build.mjs [FILE]       # by default the file that the package carries

import { readFile, writeFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = fileURLToPath(new URL(".", import.meta.url));
const target = process.argv[2] ?? `${here}../sundae_ns/scene/page.html`;

/** Shaders without comments, indentation and empty lines. */
const shaders = {
  name: "shaders",
  setup({ onLoad }) {
    onLoad({ filter: /\.(wgsl|vert|frag)$/ }, async ({ path }) => {
      const lines = (await readFile(path, "utf8")).split("\n").map((line) => line.replace(/\/\/.*/, "").trim());
      return { contents: `${lines.filter(Boolean).join("\n")}\n`, loader: "text" };
    });
  },
};

/** Three without its renderer: the controls need vectors and cameras, and its shaders would be a third of the page. */
const core = {
  name: "core",
  setup({ onResolve }) {
    onResolve({ filter: /^three$/ }, () => ({ path: `${here}node_modules/three/build/three.core.js` }));
  },
};

const { outputFiles } = await build({
  absWorkingDir: here,
  entryPoints: ["src/main.ts"],
  bundle: true,
  minify: true,
  write: false,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  plugins: [shaders, core],
});
const program = outputFiles[0].text.trim().replaceAll("</script", "<\\/script");
const { dependencies } = JSON.parse(await readFile(`${here}package.json`, "utf8"));
const licences = await Promise.all(
  Object.keys(dependencies).map(
    async (name) => `This page contains ${name}.\n\n${await readFile(`${here}node_modules/${name}/LICENSE`, "utf8")}`,
  ),
);
const template = await readFile(`${here}page.html`, "utf8");
const page = template.replace("@@PROGRAM@@", () => program).replace("@@LICENCES@@", () => licences.join("\n"));
await writeFile(target, page);
