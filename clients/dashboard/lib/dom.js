/** Building the page: elements without a framework. Text is always set as text, never as markup. */

const SVG = 'http://www.w3.org/2000/svg';

function setAttributes(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (name === 'value' || name === 'checked') element[name] = value;
    else element.setAttribute(name, value === true ? '' : String(value));
  }
}

function appendAll(element, children) {
  for (const child of children.flat(Infinity)) {
    if (child === undefined || child === null || child === false) continue;
    element.append(child instanceof Node ? child : document.createTextNode(String(child)));
  }
}

/**
 * Creates an element. Attributes whose name begins with "on" are listeners; those that are
 * undefined, null or false are left out.
 *
 * @param {string} tag "div", or "div.panel.wide" with classes
 * @param {Object<string, any>} [attributes]
 * @param {...any} children nodes, texts, numbers, or arrays of them
 * @returns {any} the element; any: so that its own members are known without a cast
 */
export function h(tag, attributes = {}, ...children) {
  const [name, ...classes] = tag.split('.');
  const element = document.createElement(name);
  if (classes.length) element.className = classes.join(' ');
  setAttributes(element, attributes);
  appendAll(element, children);
  return element;
}

/** Creates an element of SVG. */
export function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  setAttributes(element, attributes);
  appendAll(element, children);
  return element;
}

/** Replaces all children of an element. */
export function fill(element, ...children) {
  element.replaceChildren();
  appendAll(element, children);
  return element;
}

/** A button with a text that names what it does. */
export function button(text, onclick, attributes = {}) {
  return h('button', { type: 'button', onclick, ...attributes }, text);
}

/** A button that stays pressed: aria-pressed tells its state. */
export function toggle(text, pressed, onchange, attributes = {}) {
  const element = button(text, () => {
    const now = element.getAttribute('aria-pressed') !== 'true';
    element.setAttribute('aria-pressed', String(now));
    onchange(now);
  }, { 'aria-pressed': String(pressed), ...attributes });
  return element;
}

/** A list to choose one of: choices are texts or [value, text]. */
export function select(label, choices, value, onchange) {
  const options = choices.map((choice) => {
    const [key, text] = Array.isArray(choice) ? choice : [choice, choice];
    return h('option', { value: key, selected: key === value }, text);
  });
  return h('label.field', {}, h('span', {}, label),
    h('select', { onchange: (event) => onchange(event.target.value) }, options));
}

/** A table with its head. isRight: of a name and its place; numbers stand at the right. */
export function table(names, body, isRight = (name, i) => false, tag = 'table.cards') {
  return h(tag, {}, h('thead', {}, h('tr', {}, names.map((name, i) =>
    h(isRight(name, i) ? 'th.right' : 'th', { scope: 'col' }, name)))), body);
}

/** A value with its name above it, and words below. */
export function tile(name, value, words) {
  return h('div.panel.tile', {}, h('div.muted', {}, name), h('div.value', {}, value), h('div.muted', {}, words));
}

/** What a color means, in a legend. color: the name of a custom property of CSS, or a color. */
export function swatch(color, kind = '') {
  const element = h(`i.swatch${kind}`);
  element.style.color = color.startsWith('--') ? `var(${color})` : color;
  return element;
}

/** Prepares a canvas to be drawn anew at its present size; null: it has none. color: of a name as above. */
export function paint(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  if (!width || !height) return null;
  canvas.width = Math.round(width * devicePixelRatio);
  canvas.height = Math.round(height * devicePixelRatio);
  const context = canvas.getContext('2d');
  context.scale(devicePixelRatio, devicePixelRatio);
  const style = getComputedStyle(canvas);
  context.font = `12px ${style.fontFamily}`;
  const color = (name) => (name.startsWith('--') ? style.getPropertyValue(name).trim() : name);
  return { context, width, height, color };
}

/** Tells a screen reader what happened, politely. */
export function announce(text) {
  const region = document.getElementById('announcer');
  if (region) region.textContent = text;
}
