/** The dashboard's pages: address, module, place in the navigation and keyboard shortcut, each in one row. */

/**
 * Modules load on first use. `nav` is the label in the navigation; `keys` opens the page from anywhere; `docs` is the
 * page of the documentation about it.
 */
export const PAGES = [
  {
    name: "jobs",
    path: "/",
    pattern: /^\/?$/,
    load: () => import("./views/jobs.js"),
    nav: "Jobs",
    keys: ["g", "j"],
    about: "All jobs",
    docs: "tutorial.html",
  },
  {
    name: "submit",
    path: "/submit",
    pattern: /^\/submit$/,
    load: () => import("./views/submit.js"),
    keys: ["n"],
    about: "New job",
    docs: "reference/specification.html",
  },
  {
    name: "compare",
    path: "/compare",
    pattern: /^\/compare$/,
    load: () => import("./views/compare.js"),
    nav: "Compare",
    keys: ["g", "c"],
    docs: "how-to/sweeps.html",
  },
  {
    name: "studies",
    path: "/studies",
    pattern: /^\/studies$/,
    load: () => import("./views/studies.js"),
    nav: "Studies",
    keys: ["g", "s"],
    docs: "how-to/sweeps.html",
  },
  {
    name: "studies",
    pattern: /^\/studies\/(?<id>[^/]+)$/,
    load: () => import("./views/study.js"),
    docs: "how-to/sweeps.html",
  },
  {
    name: "league",
    path: "/league",
    pattern: /^\/league$/,
    load: () => import("./views/league.js"),
    nav: "League",
    keys: ["g", "l"],
    docs: "how-to/match.html",
  },
  {
    name: "league",
    pattern: /^\/matches\/(?<id>[^/]+)(?:\/(?<sub>[0-9]+))?$/,
    load: () => import("./views/match.js"),
    docs: "how-to/match.html",
  },
  {
    name: "workers",
    path: "/workers",
    pattern: /^\/workers$/,
    load: () => import("./views/workers.js"),
    nav: "Workers",
    keys: ["g", "w"],
    docs: "how-to/several-hosts.html",
  },
  {
    name: "policies",
    path: "/policies",
    pattern: /^\/policies$/,
    load: () => import("./views/policies.js"),
    nav: "Policies",
    keys: ["g", "p"],
    docs: "policies/index.html",
  },
  {
    name: "policies",
    pattern: /^\/policies-compared$/,
    load: () => import("./views/policy-compare.js"),
    docs: "how-to/registry.html",
  },
  {
    name: "policies",
    pattern: /^\/policies\/(?<id>[^/]+)$/,
    load: () => import("./views/policy.js"),
    docs: "policies/index.html",
  },
  {
    name: "jobs",
    pattern: /^\/jobs\/(?<id>[^/]+)(?:\/(?<tab>[a-z]+))?(?:\/(?<sub>[^/]+))?$/,
    load: () => import("./views/job.js"),
    docs: "reference/metrics.html",
  },
];

/** Shortcuts that open no page; those with `run` work everywhere, the others belong to a page. */
export const SHORTCUTS = [
  { keys: ["/"], about: "Search jobs" },
  { keys: ["j", "k"], about: "Next, previous job" },
  { keys: ["Enter"], about: "Open job" },
  { keys: ["x"], about: "Select job" },
  { keys: ["t"], about: "Change theme", run: "theme" },
  { keys: ["?"], about: "This list", run: "help" },
];

/** The page at a path, with the parts of the path; undefined for an unknown one. */
export function pageAt(path) {
  for (const page of PAGES) {
    const match = page.pattern.exec(path);
    if (match) return { ...page, parts: match.groups ?? {} };
  }
  return undefined;
}

/** What the key `key` opens or runs after the key `before`, if anything. */
export function shortcut(key, before) {
  const found = [...PAGES, ...SHORTCUTS.filter((s) => s.run)].find(
    ({ keys }) => keys?.at(-1) === key && keys.at(-2) === before,
  );
  return found ? { path: found.path, run: found.run } : undefined;
}
