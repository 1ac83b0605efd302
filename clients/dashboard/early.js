/** Starts to load the modules of the view in the address while those of the frame are still loading
 * (index.html lists both) and, for views that always show robots, to compile the stage. */

(() => {
  const [key] = location.hash.replace(/^#\/?/, '').split(/[/?]/);
  const view = key || 'home';
  /** @type {HTMLMetaElement} */
  const names = document.querySelector(`meta[data-view="${CSS.escape(view)}"]`);
  const folder = new URL('.', /** @type {HTMLScriptElement} */ (document.currentScript).src);
  const at = (name) => new URL(`${name}.js`, folder).href;
  for (const name of names?.content.split(' ') ?? []) {
    const link = document.createElement('link');
    document.head.append(Object.assign(link, { rel: 'modulepreload', href: at(name) }));
  }
  if (['home', 'stage', 'lab', 'campaigns'].includes(view)) {
    // If this fails, the view reports the reason.
    import(at('stage/stage')).then(({ prepareStage }) => prepareStage()).catch(() => {});
  }
})();
