//! The page, compiled into the program.

/// The content of a path: kind and text. Nothing here is secret.
pub(crate) fn asset(path: &str) -> Option<(&'static str, &'static str)> {
    Some(match path {
        "/style.css" => ("text/css; charset=utf-8", include_str!("page/style.css")),
        "/trace.js" => (SCRIPT, include_str!("page/trace.js")),
        "/spectrum.js" => (SCRIPT, include_str!("page/spectrum.js")),
        "/picture.js" => (SCRIPT, include_str!("page/picture.js")),
        "/theme.js" => (SCRIPT, include_str!("page/theme.js")),
        "/view.js" => (SCRIPT, include_str!("page/view.js")),
        "/clips.js" => (SCRIPT, include_str!("page/clips.js")),
        "/wire.js" => (SCRIPT, include_str!("page/wire.js")),
        "/page.js" => (SCRIPT, include_str!("page/page.js")),
        _ => return None,
    })
}

/// The page itself, for clients with a word.
pub(crate) const INDEX: &str = include_str!("page/index.html");

const SCRIPT: &str = "text/javascript; charset=utf-8";
