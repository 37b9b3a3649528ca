
const shown = mount(document.body, JSON.parse(document.getElementById("motions").textContent), { whole: true });
const toHash = () => {
  const at = /^#t=(\d+(?:\.\d+)?)$/.exec(location.hash);
  if (at) shown.goTo(Number(at[1]));
  return Boolean(at);
};
addEventListener("hashchange", toHash);
if (!toHash()) shown.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
