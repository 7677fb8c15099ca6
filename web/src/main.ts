// The program of the page, and of the worker that decodes for it: both run this file.

import { answer } from "./decoding";
import { start } from "./page/app";

if (typeof document === "undefined") answer();
else void start(document.currentScript?.textContent ?? "");
