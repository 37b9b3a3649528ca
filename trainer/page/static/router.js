//! Addresses of the page, and moving between them without loading it again.

/** @type {() => void} */
let changed = () => {};

/** The words of the address: `/runs/r-1/vae` is `["runs", "r-1", "vae"]`. */
export const words = () =>
  location.pathname
    .split("/")
    .filter((word) => word !== "")
    .map((word) => {
      try {
        return decodeURIComponent(word);
      } catch {
        return word;
      }
    });

/** @param {...string} parts */
export const address = (...parts) => `/${parts.map(encodeURIComponent).join("/")}`;

/** @param {string} path */
export function go(path) {
  history.pushState(null, "", path);
  changed();
}

/** Writes what a view shows into its address, without a step back to it. @param {URLSearchParams} query */
export function remember(query) {
  const text = query.toString();
  history.replaceState(null, "", location.pathname + (text ? `?${text}` : ""));
}

/** @param {() => void} whenChanged */
export function start(whenChanged) {
  changed = whenChanged;
  addEventListener("popstate", changed);
  document.addEventListener("click", (event) => {
    if (event.defaultPrevented || event.button !== 0 || event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    const link = event.target instanceof Element ? event.target.closest("a") : null;
    const href = link?.getAttribute("href") ?? "";
    if (!link || !href.startsWith("/") || href.startsWith("//") || link.target || link.hasAttribute("download")) return;
    // The book has documents of its own.
    if (href.startsWith("/book/")) return;
    event.preventDefault();
    if (href !== location.pathname + location.search) go(href);
  });
}
