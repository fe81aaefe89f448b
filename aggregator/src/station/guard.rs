//! Decides who may ask, and tells browsers what a page may do.

use std::net::IpAddr;

use axum::extract::{Request, State};
use axum::http::header::{
    AUTHORIZATION, CACHE_CONTROL, CONTENT_SECURITY_POLICY, COOKIE, HOST, HeaderName, ORIGIN, REFERRER_POLICY,
    SET_COOKIE, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse, Redirect, Response};

use super::listen::Peer;
use super::refusals::Refusals;
use super::token::Token;

/// Name of the cookie that carries the token.
const COOKIE_NAME: &str = "cosurf-token-";
/// What a page may load: only what this server has. Workers of the viewer are made of its script, as `blob:`.
const POLICY: &str = "default-src 'none'; script-src 'self'; worker-src blob:; style-src 'self'; \
                      img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
                      frame-ancestors 'none'";
/// Headers of every answer.
const HEADERS: [(HeaderName, &str); 6] = [
    (CONTENT_SECURITY_POLICY, POLICY),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (X_FRAME_OPTIONS, "DENY"),
    (REFERRER_POLICY, "no-referrer"),
    (CACHE_CONTROL, "no-store"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

/// Who may ask for what.
#[derive(Clone)]
pub(super) struct Guard {
    /// What acting needs, and beyond this computer also looking.
    pub(super) token: Token,
    /// True if the server is bound to a loopback address.
    pub(super) is_local: bool,
    /// Where refused requests are told.
    pub(super) refusals: Refusals,
}

/// Lets a request through, or answers it with a refusal; adds headers to the answer.
pub(super) async fn protect(State(guard): State<Guard>, request: Request, next: Next) -> Response {
    let mut response = match guard.admit(request.method(), request.uri(), request.headers()) {
        Ok(Admitted::Yes) => next.run(request).await,
        Ok(Admitted::Welcome) => guard.welcome(),
        Err(Refusal(status, why)) => {
            let by = request.extensions().get().map_or(IpAddr::from([0, 0, 0, 0]), |Peer(by)| *by);
            guard.refusals.note(by, request.method(), request.uri(), why);
            (status, format!("{why}\n")).into_response()
        }
    };
    for (name, value) in HEADERS {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

/// What happens to a request that is let through.
enum Admitted {
    Yes,
    /// The address carried the token: it goes into a cookie.
    Welcome,
}

/// The answer to a request that is not let through: its status, and why.
struct Refusal(StatusCode, &'static str);

impl Guard {
    /// Decides on a request.
    fn admit(&self, method: &Method, uri: &Uri, headers: &HeaderMap) -> Result<Admitted, Refusal> {
        let host = text(headers, HOST).unwrap_or_default();
        // A proxy in front might look at another of them than this server.
        let is_another = uri.authority().is_some_and(|authority| authority.as_str() != host);
        if headers.get_all(HOST).iter().count() > 1 || is_another {
            return Err(Refusal(StatusCode::BAD_REQUEST, "name this server once, in the header Host"));
        }
        // A page of another site whose name was made to lead here would otherwise read everything.
        if self.is_local && !is_local_name(host) {
            return Err(Refusal(StatusCode::FORBIDDEN, "open this server as 127.0.0.1 or localhost"));
        }
        let acts = method != Method::GET && method != Method::HEAD;
        if acts && !is_same_site(headers, host) {
            return Err(Refusal(StatusCode::FORBIDDEN, "a page of another site may not act here"));
        }
        if method == Method::GET && uri.path() == "/" && self.has_token_in_query(uri) {
            return Ok(Admitted::Welcome);
        }
        let has_token = shown(headers).any(|text| self.token.is(text));
        if !has_token && (acts || !self.is_local) {
            let how =
                "a token is needed: open the address that the program printed, or send it as a bearer token";
            return Err(Refusal(StatusCode::UNAUTHORIZED, how));
        }
        Ok(Admitted::Yes)
    }

    fn has_token_in_query(&self, uri: &Uri) -> bool {
        let parts = uri.query().unwrap_or_default().split('&');
        parts.filter_map(|part| part.strip_prefix("token=")).any(|text| self.token.is(text))
    }

    /// Puts the token into a cookie, and out of the address, which a browser keeps in its history.
    fn welcome(&self) -> Response {
        let cookie = format!("{}; HttpOnly; SameSite=Strict; Path=/", cookie_of(&self.token));
        let mut response = Redirect::to("/").into_response();
        if let Ok(cookie) = HeaderValue::from_str(&cookie) {
            response.headers_mut().insert(SET_COOKIE, cookie);
        }
        response
    }
}

/// The cookie with a token: name and value. Browsers send a cookie to all ports of a computer, so each token has a name of its
/// own, or two stations would replace each other's.
fn cookie_of(token: &Token) -> String {
    let token = token.as_str();
    let name = &blake3::hash(token.as_bytes()).to_hex()[..8];
    format!("{COOKIE_NAME}{name}={token}")
}

/// The texts of a request that may be the token: of the header for scripts, and of the cookies.
fn shown(headers: &HeaderMap) -> impl Iterator<Item = &str> {
    let bearer = text(headers, AUTHORIZATION).and_then(|value| value.strip_prefix("Bearer "));
    let cookies = text(headers, COOKIE).unwrap_or_default().split(';');
    let values =
        cookies.filter_map(|cookie| Some(cookie.trim().strip_prefix(COOKIE_NAME)?.split_once('=')?.1));
    bearer.into_iter().chain(values)
}

fn text(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    headers.get(name)?.to_str().ok()
}

/// True if a `Host` header names this computer by a loopback address or as localhost.
fn is_local_name(host: &str) -> bool {
    let name = match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((address, _)) => address,
        None => host.split(':').next().unwrap_or_default(),
    };
    name == "localhost" || name.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// True unless a browser says that a page of another site asks.
fn is_same_site(headers: &HeaderMap, host: &str) -> bool {
    let is_ours = |origin: &str| origin.strip_prefix("http://").is_some_and(|rest| rest == host);
    let fetch_site = text(headers, HeaderName::from_static("sec-fetch-site"));
    text(headers, ORIGIN).is_none_or(is_ours)
        && headers.get(ORIGIN).is_none_or(|origin| origin.to_str().is_ok())
        && fetch_site.is_none_or(|site| site == "same-origin" || site == "none")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn guard(is_local: bool) -> Guard {
        Guard { token: Token::random().unwrap(), is_local, refusals: Refusals::new(|_| ()) }
    }

    fn headers(entries: &[(&'static str, &str)]) -> HeaderMap {
        let entry = |(name, value): &(&'static str, &str)| {
            (HeaderName::from_static(name), HeaderValue::from_str(value).unwrap())
        };
        entries.iter().map(entry).collect()
    }

    fn status(guard: &Guard, method: Method, uri: &str, entries: &[(&'static str, &str)]) -> u16 {
        let answer = guard.admit(&method, &uri.parse().unwrap(), &headers(entries));
        answer.err().map_or(200, |Refusal(status, _)| status.as_u16())
    }

    #[test]
    fn on_this_computer_looking_is_free_and_acting_needs_the_token() {
        let guard = guard(true);
        let bearer = format!("Bearer {}", guard.token.as_str());
        let cookie = format!("a=b; {}; {}", cookie_of(&Token::random().unwrap()), cookie_of(&guard.token));
        let host = ("host", "127.0.0.1:8080");
        assert_eq!(status(&guard, Method::GET, "/", &[host]), 200);
        assert_eq!(status(&guard, Method::GET, "/", &[("host", "[::1]:8080")]), 200);
        assert_eq!(status(&guard, Method::GET, "/", &[("host", "evil.example")]), 403);
        assert_eq!(status(&guard, Method::GET, "/", &[("host", "127.0.0.1.evil.example")]), 403);
        assert_eq!(status(&guard, Method::GET, "/", &[]), 403);
        assert_eq!(status(&guard, Method::GET, "http://evil.example/", &[host]), 400);
        assert_eq!(status(&guard, Method::GET, "http://127.0.0.1:8080/", &[host]), 200);
        assert_eq!(status(&guard, Method::POST, "/x", &[host]), 401);
        assert_eq!(status(&guard, Method::POST, "/x", &[host, ("authorization", &bearer)]), 200);
        assert_eq!(status(&guard, Method::POST, "/x", &[host, ("cookie", &cookie)]), 200);
        assert_eq!(status(&guard, Method::POST, "/x", &[host, ("authorization", "Bearer x")]), 401);
    }

    #[test]
    fn a_page_of_another_site_cannot_act_even_with_the_cookie() {
        let guard = guard(true);
        let cookie = cookie_of(&guard.token);
        let with = |more: (&'static str, &str)| {
            status(&guard, Method::POST, "/x", &[("host", "localhost:1"), ("cookie", &cookie), more])
        };
        assert_eq!(with(("origin", "http://localhost:1")), 200);
        assert_eq!(with(("origin", "http://localhost:2")), 403);
        assert_eq!(with(("origin", "null")), 403);
        assert_eq!(with(("sec-fetch-site", "cross-site")), 403);
        assert_eq!(with(("sec-fetch-site", "same-origin")), 200);
    }

    #[test]
    fn beyond_this_computer_everything_needs_the_token_which_an_address_may_carry_once() {
        let guard = guard(false);
        let host = ("host", "192.168.1.10:80");
        assert_eq!(status(&guard, Method::GET, "/", &[host]), 401);
        assert_eq!(status(&guard, Method::GET, "/?token=wrong", &[host]), 401);
        let uri = format!("/?token={}", guard.token.as_str());
        let admitted = guard.admit(&Method::GET, &uri.parse().unwrap(), &headers(&[host]));
        assert!(matches!(admitted, Ok(Admitted::Welcome)));
        let answer = guard.welcome();
        assert_eq!(
            (answer.status().as_u16(), &answer.headers()["location"]),
            (303, &HeaderValue::from_static("/"))
        );
        let cookie = answer.headers()["set-cookie"].to_str().unwrap();
        assert!(cookie.contains("HttpOnly; SameSite=Strict"), "{cookie}");
        let its = cookie.split(';').next().unwrap();
        assert_eq!(status(&guard, Method::GET, "/model.spz", &[host, ("cookie", its)]), 200);
        assert_eq!(status(&guard, Method::GET, &format!("/model.spz?token={its}"), &[host]), 401);
    }
}
