//! The address of a queue's server, with or without a user and a password: `nats://user:password@host:4222`.

use async_nats::{ConnectOptions, ServerAddr};

/// The address of a server.
pub(super) struct Address {
    server: ServerAddr,
    user: Option<(String, String)>,
}

impl Address {
    /// Reads an address. The error does not repeat it, because it may contain a password.
    pub(super) fn parse(url: &str) -> Result<Self, String> {
        let server: ServerAddr = url.parse().map_err(|_| "not the address of a NATS server".to_owned())?;
        let password = server.password().unwrap_or_default();
        let user = server.username().map(|user| (plain(user), plain(password)));
        Ok(Self { server, user })
    }

    /// The server, for a connection.
    pub(super) fn server(&self) -> &ServerAddr {
        &self.server
    }

    /// How to connect: as the user of the address, if it names one. The library itself ignores the user of an address.
    pub(super) fn options(&self) -> ConnectOptions {
        match self.user.clone() {
            Some((user, password)) => ConnectOptions::with_user_and_password(user, password),
            None => ConnectOptions::new(),
        }
    }
}

/// The address without user and password, for errors.
pub(super) fn shown(url: &str) -> String {
    match (url.split_once("://"), url.rsplit_once('@')) {
        (Some((scheme, _)), Some((_, host))) => format!("{scheme}://{host}"),
        (None, Some((_, host))) => host.to_owned(),
        (_, None) => url.to_owned(),
    }
}

/// Text in which signs that an address cannot have are written as `%` and two hexadecimal digits.
fn plain(text: &str) -> String {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let [first, others @ ..] = rest {
        let coded = others.get(..2).filter(|_| *first == b'%');
        let coded = coded.and_then(|digits| u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok());
        bytes.push(coded.unwrap_or(*first));
        rest = if coded.is_some() { &others[2..] } else { others };
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn user_and_password_are_read_and_not_shown() {
        let user = |url: &str| Address::parse(url).unwrap().user;
        let known = |user: &str, password: &str| Some((user.to_owned(), password.to_owned()));
        assert_eq!(user("nats://host:4222"), None);
        assert_eq!(user("nats://cosurf:secret@host:4222"), known("cosurf", "secret"));
        assert_eq!(user("nats://cosurf:a%40b%2Fc%@host"), known("cosurf", "a@b/c%"));
        assert!(Address::parse("ftp://cosurf:secret@host").is_err_and(|error| !error.contains("secret")));
        assert_eq!(shown("nats://cosurf:s@cret@host:4222"), "nats://host:4222");
        assert_eq!(shown("cosurf:secret@host"), "host");
        assert_eq!(shown("nats://host:4222"), "nats://host:4222");
    }
}
