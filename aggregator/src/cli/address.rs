//! The addresses at which browsers open a server of this program.
//!
//! What it knows nothing about: what is served, and who may look.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use cosurf_aggregator::station::Token;

/// Parses the address to bind: numbers and a port.
pub(crate) fn parse_address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| {
        "write an IP address in numbers and a port, for example 127.0.0.1:8080 in place of localhost:8080, or [::1]:8080"
            .to_owned()
    })
}

/// The addresses of a server that is bound to this one, a line each, first that for other computers. They carry the token if there
/// is one.
pub(crate) fn urls(bound: SocketAddr, token: Option<&Token>) -> String {
    let of_computer =
        || if_addrs::get_if_addrs().unwrap_or_default().into_iter().filter(|its| !its.is_link_local());
    let ips = match bound.ip() {
        ip if ip.is_unspecified() => reachable(ip.is_ipv6(), of_computer().map(|its| its.ip())),
        ip => vec![ip],
    };
    let query = token.map_or_else(String::new, |token| format!("?token={}", token.as_str()));
    let url = |ip: IpAddr| format!("http://{}/{query}\n", SocketAddr::new(ip, bound.port()));
    ips.into_iter().map(url).collect()
}

/// Of the addresses of this computer, those at which a server is reached that is bound to all of IPv4 or IPv6.
fn reachable(is_v6: bool, of_computer: impl Iterator<Item = IpAddr>) -> Vec<IpAddr> {
    // Windows keeps the two apart.
    let takes_both = is_v6 && cfg!(unix);
    let mut ips: Vec<IpAddr> = of_computer.filter(|ip| takes_both || ip.is_ipv6() == is_v6).collect();
    ips.push(if is_v6 { Ipv6Addr::LOCALHOST.into() } else { Ipv4Addr::LOCALHOST.into() });
    ips.sort_by_key(|ip| (ip.is_loopback(), *ip));
    ips.dedup();
    ips
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_by_name_is_refused_with_the_remedy() {
        assert_eq!(parse_address("[::1]:80"), Ok(SocketAddr::from((Ipv6Addr::LOCALHOST, 80))));
        for wrong in ["localhost:8080", "127.0.0.1", "8080", ""] {
            assert!(
                parse_address(wrong).is_err_and(|error| error.contains("in numbers and a port")),
                "{wrong}"
            );
        }
    }

    #[test]
    fn a_server_of_all_networks_has_addresses_that_open() {
        let here: [IpAddr; 4] = [
            [127, 0, 0, 1].into(),
            [192, 168, 1, 10].into(),
            [10, 0, 0, 3].into(),
            Ipv6Addr::LOCALHOST.into(),
        ];
        assert_eq!(reachable(false, here.into_iter()), [here[2], here[1], here[0]]);
        assert_eq!(reachable(false, [].into_iter()), [here[0]], "a computer without networks");
        let both = reachable(true, here.into_iter());
        assert!(both.contains(&here[3]) && both.contains(&here[1]) == cfg!(unix), "{both:?}");
        let all = urls(SocketAddr::from(([0, 0, 0, 0], 8080)), None);
        assert!(all.ends_with("http://127.0.0.1:8080/\n") && !all.contains("0.0.0.0"), "{all}");
    }

    #[test]
    fn a_server_of_one_address_has_that() {
        assert_eq!(urls(SocketAddr::from(([10, 0, 0, 3], 80)), None), "http://10.0.0.3:80/\n");
        let six = urls(SocketAddr::from((Ipv6Addr::LOCALHOST, 80)), None);
        assert_eq!(six, "http://[::1]:80/\n");
    }
}
