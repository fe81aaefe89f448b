//! A port on which a program will listen.

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpListener};

use super::Finding;

/// Checks that nobody listens on the address yet. `setting` names where the address is written.
pub fn check(address: SocketAddr, setting: &str) -> Finding {
    let cause = match TcpListener::bind(address) {
        Ok(_) => return Finding::ok("port", format!("{address} is free")),
        Err(cause) => cause,
    };
    let remedy = match cause.kind() {
        ErrorKind::AddrInUse => format!("stop the program that listens there, or change {setting}"),
        ErrorKind::PermissionDenied => format!("ports below 1024 need a privilege: change {setting}"),
        ErrorKind::AddrNotAvailable => {
            format!("this computer does not have this address: change {setting}, for example to 0.0.0.0")
        }
        _ => format!("change {setting}"),
    };
    Finding::mend("port", format!("{address}: {cause}"), remedy)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_port_in_use_must_be_mended() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = taken.local_addr().unwrap();
        let finding = check(address, "`bind`");
        assert!(finding.is_fault() && finding.to_string().contains("change `bind`"), "{finding}");
        drop(taken);
        assert!(!check(address, "`bind`").is_fault());
    }
}
