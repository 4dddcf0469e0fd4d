// Colours of the roles (measured, predicted, …), read from the style sheet so that 3D view, curves and legend
// agree and follow the colour scheme.

export function colour(role) {
  const found = getComputedStyle(document.documentElement).getPropertyValue(`--${role}`).trim();
  if (!found) throw new Error(`the palette has no colour for ${role}`);
  return found;
}

/** Calls `listener` when the person switches between light and dark. */
export function onSchemeChange(listener) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", listener);
}
