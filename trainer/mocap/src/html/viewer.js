
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("motions").textContent);
  const by = (id) => document.getElementById(id);
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
  const START = { yaw: -0.65, pitch: 0.26, zoom: 1 };
  const view = { ...START };
  // Seconds that the end is shown before the motion begins again.
  const PAUSE = 0.6;
  let time = 0, playing = false, speed = 1, colours = {};

  const readColours = () => {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["panel", "grid", "trail", "shadow", "body", "left", "right", "told"]) {
      colours[name] = style.getPropertyValue("--" + name).trim();
    }
  };

  // Metres, [frames, joints, 3].
  const decode = (motion) => {
    const bytes = Uint8Array.from(atob(motion.joints), (c) => c.charCodeAt(0));
    const numbers = new DataView(bytes.buffer);
    const joints = new Float32Array(bytes.length / 2);
    for (let i = 0; i < joints.length; i++) {
      joints[i] = motion.origin[i % 3] + motion.step * numbers.getInt16(2 * i, true);
    }
    return joints;
  };

  const prepare = (motion, canvas) => {
    const body = data.bodies[motion.body], joints = decode(motion), count = body.parents.length, width = 3 * count;
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    let bottom = Infinity, top = -Infinity, wide = 0;
    for (let t = 0; t < motion.frames; t++) {
      [joints[t * width], joints[t * width + 2]].forEach((value, k) => {
        low[k] = Math.min(low[k], value);
        high[k] = Math.max(high[k], value);
      });
      for (let j = 0; j < count; j++) {
        const root = t * width, at = root + 3 * j;
        bottom = Math.min(bottom, joints[at + 1]);
        top = Math.max(top, joints[at + 1]);
        wide = Math.max(wide, Math.hypot(joints[at] - joints[root], joints[at + 2] - joints[root + 2]));
      }
    }
    // The camera's course: the root's, averaged over a second.
    const reach = Math.max(1, Math.round(motion.fps / 2)), course = [];
    for (let t = 0; t < motion.frames; t++) {
      const from = Math.max(0, t - reach), to = Math.min(motion.frames - 1, t + reach), sum = [0, 0];
      for (let s = from; s <= to; s++) {
        sum[0] += joints[s * width];
        sum[1] += joints[s * width + 2];
      }
      course.push(sum.map((value) => value / (to - from + 1)));
    }
    const bones = body.parents.map((parent, joint) => [parent, joint]).filter(([parent, joint]) => parent !== joint);
    const height = clamp(top - Math.min(0, bottom), 1.2, 2.4);
    return {
      canvas, body, joints, count, width, bones, course, height, wide: clamp(wide, 0.3, 3),
      fps: motion.fps, frames: motion.frames, waypoints: motion.waypoints,
      middle: [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2],
      extent: Math.hypot(high[0] - low[0], high[1] - low[1]),
      visible: true, dirty: true,
    };
  };

  const canvases = [...document.querySelectorAll("canvas")];
  const panels = data.motions.map((motion, i) => prepare(motion, canvases[i]));
  const fastest = Math.max(...panels.map((panel) => panel.fps));
  const duration = Math.max(...panels.map((panel) => (panel.frames - 1) / panel.fps));
  const stir = () => panels.forEach((panel) => { panel.dirty = true; });

  // Where the figure is at `time`: between two frames their mixture, behind the last one that.
  const pose = (panel) => {
    const at = clamp(time * panel.fps, 0, panel.frames - 1), from = Math.floor(at + 1e-6);
    const to = Math.min(from + 1, panel.frames - 1), share = Math.max(0, at - from), points = [];
    const mix = (a, b) => a + (b - a) * share;
    for (let j = 0; j < panel.count; j++) {
      const a = from * panel.width + 3 * j, b = to * panel.width + 3 * j;
      points.push([0, 1, 2].map((k) => mix(panel.joints[a + k], panel.joints[b + k])));
    }
    return { points, frame: from, centre: [0, 1].map((k) => mix(panel.course[from][k], panel.course[to][k])) };
  };

  // A function from metres to pixels, the scale there, and how near it is.
  const camera = (panel, centre, follow, size) => {
    const body = Math.max(1.3 * panel.height, 0.5 * panel.height + 1.8 * panel.wide);
    const span = follow ? body : Math.max(body, 0.9 * panel.height + 0.8 * panel.extent);
    const [x0, z0] = follow ? centre : panel.middle, y0 = 0.5 * panel.height;
    const distance = 3 * span, scale = (Math.min(size[0], size[1]) * view.zoom) / span;
    const sin = Math.sin(view.yaw), cos = Math.cos(view.yaw), up = Math.cos(view.pitch), tip = Math.sin(view.pitch);
    const project = ([x, y, z]) => {
      const dx = x - x0, dy = y - y0, dz = z - z0;
      const right = dx * cos - dz * sin, near = dx * sin + dz * cos;
      const depth = near * up + dy * tip, local = (scale * distance) / Math.max(distance - depth, 0.05 * distance);
      return { x: size[0] / 2 + local * right, y: size[1] / 2 - local * (dy * up - near * tip), scale: local, depth };
    };
    return { project, centre: [x0, z0], radius: 1.25 * span };
  };

  const draw = (panel) => {
    const { canvas } = panel, ratio = window.devicePixelRatio || 1, size = [canvas.clientWidth, canvas.clientHeight];
    if (!size[0] || !size[1]) return;
    const pixels = size.map((length) => Math.round(length * ratio));
    if (canvas.width !== pixels[0] || canvas.height !== pixels[1]) [canvas.width, canvas.height] = pixels;
    const context = canvas.getContext("2d"), { points, frame, centre } = pose(panel);
    const { project, centre: [x0, z0], radius } = camera(panel, centre, by("follow").checked, size);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, size[0], size[1]);
    context.lineCap = "round";
    const line = (a, b, width, colour) => {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.beginPath();
      context.moveTo(a.x, a.y);
      context.lineTo(b.x, b.y);
      context.stroke();
    };
    const disc = (at, pixels, colour) => {
      context.fillStyle = colour;
      context.beginPath();
      context.arc(at.x, at.y, pixels, 0, 2 * Math.PI);
      context.fill();
    };

    // The floor is round, so that it has no corner that turns.
    const cell = radius > 6 ? 0.5 * Math.ceil(radius / 6) : 0.5;
    for (const along of [0, 1]) {
      const middle = along ? z0 : x0, other = along ? x0 : z0;
      for (let v = Math.ceil((middle - radius) / cell) * cell; v <= middle + radius; v += cell) {
        const half = Math.sqrt(Math.max(0, radius * radius - (v - middle) * (v - middle)));
        const end = (w) => project(along ? [w, 0, v] : [v, 0, w]);
        line(end(other - half), end(other + half), 1, colours.grid);
      }
    }
    const floor = ([x, , z]) => project([x, 0, z]);
    for (const [a, b] of panel.bones) line(floor(points[a]), floor(points[b]), 0.035 * floor(points[b]).scale, colours.shadow);
    context.strokeStyle = colours.trail;
    context.lineWidth = 2;
    context.beginPath();
    for (let t = 0; t <= frame; t++) {
      const at = floor([panel.joints[t * panel.width], 0, panel.joints[t * panel.width + 2]]);
      if (t) context.lineTo(at.x, at.y);
      else context.moveTo(at.x, at.y);
    }
    context.stroke();

    const waypoint = ([, , x, y, z]) => project([x, y, z]);
    panel.waypoints.forEach((here, i) => {
      const before = panel.waypoints[i - 1];
      context.globalAlpha = 0.45;
      if (before && before[1] === here[1]) line(waypoint(before), waypoint(here), 1.5, colours.told);
      context.globalAlpha = here[0] <= frame ? 1 : 0.5;
      disc(waypoint(here), 4, colours.told);
    });
    context.globalAlpha = 1;

    // Far bones first, each with an edge of the background, so that one passes visibly in front of another.
    const sides = { m: "body", l: "left", r: "right" }, small = 0.55 * panel.height / 1.7;
    const bones = panel.bones.map(([a, b]) => ({ a: project(points[a]), b: project(points[b]), from: a, to: b }));
    bones.sort((one, two) => one.a.depth + one.b.depth - two.a.depth - two.b.depth);
    for (const bone of bones) {
      const side = panel.body.sides[bone.to], colour = colours[sides[side]];
      const width = (panel.count > 30 ? 0.6 : 1) * (side === "m" ? 0.1 : 0.085) * small * (bone.a.scale + bone.b.scale) / 2;
      line(bone.a, bone.b, width + 2, colours.panel);
      line(bone.a, bone.b, width, colour);
      if (bone.to === panel.body.head) {
        const lift = [0, 1, 2].map((k) => points[bone.to][k] + 0.35 * (points[bone.to][k] - points[bone.from][k]));
        disc(project(lift), 0.115 * (panel.height / 1.7) * bone.b.scale, colour);
      }
    }
    panel.dirty = false;
  };

  const play = by("play"), slider = by("time"), clock = by("clock"), speeds = by("speed");
  slider.max = Math.max(1, Math.round(duration * fastest));
  const show = () => {
    const frame = Math.round(Math.min(time, duration) * fastest);
    slider.value = frame;
    const text = `${Math.min(time, duration).toFixed(2)} of ${duration.toFixed(2)} s, frame ${frame}`;
    clock.textContent = text;
    slider.setAttribute("aria-valuetext", text);
  };
  let last = 0, asked = false;
  const ask = () => {
    if (!asked) {
      asked = true;
      requestAnimationFrame(tick);
    }
  };
  const tick = (now) => {
    asked = false;
    if (playing) {
      time += Math.min(0.25, (now - last) / 1000) * speed;
      last = now;
      if (time > duration + PAUSE * speed) time = 0;
      stir();
    }
    show();
    panels.filter((panel) => panel.visible && panel.dirty).forEach(draw);
    if (playing) ask();
  };
  const update = () => { stir(); ask(); };
  const setPlaying = (on) => {
    playing = on;
    last = performance.now();
    play.textContent = on ? "Stop" : "Play";
    if (on && time >= duration) time = 0;
    update();
  };
  const goTo = (seconds) => {
    setPlaying(false);
    time = clamp(seconds, 0, duration);
    update();
  };
  const step = (frames) => goTo((Math.round(Math.min(time, duration) * fastest) + frames) / fastest);
  const turn = (yaw, pitch) => {
    view.yaw += yaw;
    view.pitch = clamp(view.pitch + pitch, -0.3, 1.55);
    update();
  };
  const zoom = (factor) => { view.zoom = clamp(view.zoom * factor, 0.2, 8); update(); };
  const reset = () => { Object.assign(view, START); update(); };
  const faster = (by_) => {
    speeds.selectedIndex = clamp(speeds.selectedIndex + by_, 0, speeds.options.length - 1);
    speed = Number(speeds.value);
  };

  play.addEventListener("click", () => setPlaying(!playing));
  slider.addEventListener("input", () => goTo(Number(slider.value) / fastest));
  speeds.addEventListener("change", () => { speed = Number(speeds.value); });
  by("follow").addEventListener("change", update);
  by("reset").addEventListener("click", reset);

  for (const { canvas } of panels) {
    const fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
      if (other) {
        const apart = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
        zoom(apart(event) / Math.max(1, apart(before)));
      } else {
        turn((before.clientX - event.clientX) * -0.008, (event.clientY - before.clientY) * 0.008);
      }
      fingers.set(event.pointerId, event);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("dblclick", reset);
    // The wheel scrolls the page unless the figure was chosen.
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      zoom(Math.exp(-0.0015 * event.deltaY));
    }, { passive: false });
  }

  document.addEventListener("keydown", (event) => {
    const where = event.target.tagName;
    if (event.ctrlKey || event.metaKey || event.altKey || where === "SELECT") return;
    const arrows = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    const often = event.shiftKey ? 10 : 1;
    const keys = {
      " ": () => setPlaying(!playing), ArrowLeft: () => step(-often), ArrowRight: () => step(often),
      Home: () => goTo(0), End: () => goTo(duration), "[": () => faster(-1), "]": () => faster(1),
      "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15), 0: reset,
      f: () => { by("follow").checked = !by("follow").checked; update(); },
    };
    if (where === "CANVAS" && arrows[event.key]) turn(...arrows[event.key]);
    else if (event.key === " " && (where === "BUTTON" || event.target.type === "checkbox")) return;
    else if (where === "INPUT" && event.key.startsWith("Arrow") && event.target.type !== "range") return;
    else if (keys[event.key]) keys[event.key]();
    else return;
    event.preventDefault();
  });

  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const panel = panels[canvases.indexOf(entry.target)];
      panel.visible = entry.isIntersecting;
      panel.dirty = true;
    }
    ask();
  });
  const sized = new ResizeObserver(update);
  for (const { canvas } of panels) {
    seen.observe(canvas);
    sized.observe(canvas);
  }
  const recolour = () => { readColours(); update(); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);

  readColours();
  const toHash = () => {
    const at = /^#t=(\d+(?:\.\d+)?)$/.exec(location.hash);
    if (at) goTo(Number(at[1]));
    return Boolean(at);
  };
  addEventListener("hashchange", toHash);
  if (!toHash()) setPlaying(!matchMedia("(prefers-reduced-motion: reduce)").matches);
})();
