//! Colours of runs where several stand beside each other, and small signs of them.

import { COLOURS } from "./chart.js";
import { html, svg } from "./vendor/lit-html.js";

/** @param {number} at */
export const lineClass = (at) => `line-${(at % COLOURS) + 1} dash-${Math.floor(at / COLOURS) % 3}`;

/** A short piece of a line as the chart draws it. @param {number} at */
export const swatch = (at) => html`<svg class="swatch ${lineClass(at)}" viewBox="0 0 22 8" aria-hidden="true">${svg`<line x1="1" y1="4" x2="21" y2="4"></line>`}</svg>`;
