//! The names of clients.

use std::fmt;
use std::sync::Arc;

use cosurf_contract::Escaped;

/// Who a client has proved to be.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum User {
    /// Nobody: the broker is open.
    Stranger,
    /// A user by password or certificate.
    Named(Box<str>),
    /// A part of this program.
    House,
}

/// The name of a session: its user and its client id. Different users may use the same client id without disturbing
/// each other.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Client(Arc<(User, Box<str>)>);

impl Client {
    pub(super) fn new(user: User, id: &str) -> Self {
        Self(Arc::new((user, id.into())))
    }

    pub(super) fn user(&self) -> &User {
        &self.0.0
    }

    pub(super) fn id(&self) -> &str {
        &self.0.1
    }

    pub(super) fn is_house(&self) -> bool {
        *self.user() == User::House
    }

    /// Who answers for what the client keeps.
    pub(super) fn party(&self) -> Party<'_> {
        match self.user() {
            User::Named(name) => Party::User(name),
            User::Stranger | User::House => Party::Client(self),
        }
    }
}

/// Who answers for what is kept: a user for all of its clients together, anybody else for one client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Party<'a> {
    User(&'a str),
    Client(&'a Client),
}

impl fmt::Display for Client {
    /// Writes the client id, in which control characters are escaped.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", Escaped(self.id()))
    }
}
