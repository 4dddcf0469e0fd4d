// Makes htmx a global before its extensions, which expect one, are evaluated.

import htmx from "htmx.org/dist/htmx.esm.js";

globalThis.htmx = htmx;

export default htmx;
