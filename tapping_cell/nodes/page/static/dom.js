"use strict";
// Helpers of all scripts of the page.

const $ = (id) => document.getElementById(id);

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// Create an element with these properties and this content.
function create(tag, properties = {}, ...content) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...content);
  return made;
}

// Return whether an element already shows these values, and store them.
function isShown(element, ...values) {
  const key = JSON.stringify(values), same = element.dataset.key === key;
  element.dataset.key = key;
  return same;
}

function sentence(text) {
  return text ? text[0].toUpperCase() + text.slice(1) + (/[.!?)]$/.test(text) ? "" : ".") : "";
}

function signed(value, digits = 1, unit = "") {
  if (value === null || value === undefined) return "?";
  const text = Math.abs(value).toFixed(digits);
  const sign = Number(text) === 0 ? "" : value < 0 ? "\u2212" : "+";
  return sign + text + unit;
}

function counted(number, noun) {
  return `${number} ${noun}${number === 1 ? "" : "s"}`;
}

// Points in fractions of the image size, as in the messages of the node, in the units of the overlay.
const scaled = ([u, v]) => [1000 * u, 1000 * Ghost.aspect * v];
const pointList = (points) => points.map((p) => p.map((n) => n.toFixed(1)).join(",")).join(" ");
